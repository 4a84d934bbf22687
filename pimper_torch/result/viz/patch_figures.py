"""One patch, and any quantity of all patches in a view, as figures."""

from typing import TYPE_CHECKING

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from pimper_torch.ground.geometry.visibility import cast_view
from pimper_torch.ground.shapes import Maps
from pimper_torch.records import (
    Cameras,
    CoarseMesh,
    DepthPatches,
    PatchSet,
    PatchViews,
    PhotometricPatches,
    SweptPatches,
)
from pimper_torch.result.viz.maps import normal_colors
from pimper_torch.runtime.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

AnyPatch = PatchSet | PatchViews | PhotometricPatches | SweptPatches | DepthPatches


def plot_patch(
    patch: AnyPatch, seen: PatchViews | None = None, sample: tuple[int, int] | None = None
) -> "Figure":
    """Draw the values of one patch in a record, on its template's raster.

    Of :class:`PatchViews` every view that shows it; of the others albedo, normals (red right, green
    up, blue to the viewer), confidence and heights, as far as the record has them. With views and
    photometry, also the residual of every sample, and a sample's radiance in every view that has
    it, observed and predicted.

    Args:
        patch: A record of one patch, such as ``heights[17]``.
        seen: Views on the same patch, such as ``seen[17]``.
        sample: Row and column of the sample whose light is drawn; the one with the largest
            residual unless given.

    Raises:
        InputError: The record has more patches than one, or none; the views are of another patch;
            no view has the sample.
    """
    if len(patch) != 1:
        raise InputError(
            f"plot_patch got {len(patch)} patches; needed: one, such as `patches[17]`."
        )
    panels = _panels(patch)
    residual = None if seen is None else _residual(patch, seen)
    if residual is not None:
        panels.append(("residual", residual.square().nanmean(dim=0).sqrt()))
    panels = _cropped(patch, panels)
    figure = _figure(len(panels) + (residual is not None))
    all_axes = figure.subplots(1, len(panels) + (residual is not None), squeeze=False)[0]
    if seen is not None and residual is not None:
        _draw_light(all_axes[-1], seen, residual, sample)
    for axes, (title, raster) in zip(all_axes, panels, strict=False):
        picture = raster.detach().float().cpu()
        if picture.ndim == 3:
            axes.imshow(picture.clamp(0, 1).numpy())
        else:
            figure.colorbar(axes.imshow(picture.numpy()), ax=axes, shrink=0.7)
        axes.set_title(title, fontsize="small")
        axes.set_axis_off()
    return figure


def _residual(patch: AnyPatch, seen: PatchViews) -> Maps:
    """Return observed less predicted gray radiance; NaN where a view has no sample."""
    facets = [one.buckets[0].facet.tolist() for one in (_templates(patch), seen.patches)]
    if isinstance(patch, PatchSet | PatchViews) or facets[0] != facets[1]:
        raise InputError(
            f"plot_patch got a {type(patch).__name__} of facet {facets[0]} and views of facet "
            f"{facets[1]}; needed: photometry of one patch, and views of the same."
        )
    photometric = patch if isinstance(patch, PhotometricPatches) else patch.photometric
    (found,), (views,) = photometric.buckets, seen.buckets
    known = views.valid[0] & found.observed[0]
    return torch.where(known, views.gray[0] - found.predicted[0].mean(dim=1), torch.nan).detach()


def _draw_light(
    axes: "Axes", seen: PatchViews, residual: Maps, sample: tuple[int, int] | None
) -> None:
    """Draw a sample's radiance in every view that has it, observed and predicted."""
    (views,), (templates,) = seen.buckets, seen.patches.buckets
    if sample is None:
        worst = int(residual.square().nansum(dim=0).argmax())
        sample = worst // residual.shape[2], worst % residual.shape[2]
    row, column = sample
    off = residual[:, row, column].cpu()
    (shown,) = torch.nonzero(off.isfinite(), as_tuple=True)
    if not len(shown):
        raise InputError(f"plot_patch: no view has sample {sample}; needed: one that is lit.")
    observed = views.gray[0, shown.to(views.valid.device), row, column].detach().cpu()
    numbers = templates.rows(len(off)).cpu()[shown].numpy()
    axes.plot(numbers, observed.numpy(), "k.", label="observed")
    axes.plot(numbers, (observed - off[shown]).numpy(), "C1_", label="predicted")
    axes.set_title(f"sample {row}, {column}", fontsize="small")
    axes.set_xlabel("view", fontsize="small")
    axes.legend(fontsize="x-small")


def _templates(patches: AnyPatch) -> PatchSet:
    return patches if isinstance(patches, PatchSet) else patches.patches


def plot_in_view(
    coarse: CoarseMesh,
    cameras: Cameras,
    view: int,
    values: Shaped[Tensor, " face"],
    title: str = "",
) -> "Figure":
    """Draw a number for each facet where a view shows it.

    Args:
        values: One a facet, such as residuals or numbers of views; see :func:`by_facet`.

    Raises:
        InputError: There is not one value for each facet.
    """
    if len(values) != len(coarse.mesh.faces):
        raise InputError(
            f"plot_in_view got {len(values)} values; needed: one for each of "
            f"{len(coarse.mesh.faces)} facets, as `by_facet` gives."
        )
    face = cast_view(coarse.mesh, cameras, view).face
    shown = values.detach().float().to(face.device)[face.clamp_min(0)]
    picture = torch.where(face >= 0, shown, torch.nan).cpu()
    figure = _figure(2)
    axes = figure.add_subplot()
    figure.colorbar(axes.imshow(picture.numpy()), ax=axes)
    axes.set_title(title)
    axes.set_axis_off()
    return figure


def by_facet(patches: AnyPatch, name: str) -> Float[Tensor, " face"]:
    """Gather a number of every patch, in the order of the facets; NaN where there is no patch.

    Args:
        name: Of the field, such as ``status``, or of one inside, ``convergence.residual``; one
            value a patch.

    Raises:
        InputError: The buckets have no such field, or more values than patches.
    """
    templates = _templates(patches)
    found = torch.full((len(templates.coarse.mesh.faces),), torch.nan)
    for own, bucket in zip(templates.buckets, patches.buckets, strict=True):
        value: object = bucket
        for part in name.split("."):
            value = getattr(value, part, None)
        if not isinstance(value, Tensor) or value.shape != own.facet.shape:
            raise InputError(
                f"by_facet: {name} of {type(bucket).__name__} is "
                f"{tuple(value.shape) if isinstance(value, Tensor) else value}; needed: a field "
                "with one value a patch."
            )
        found[own.facet.cpu()] = value.detach().float().cpu()
    return found


def _panels(patch: AnyPatch) -> list[tuple[str, Tensor]]:
    if isinstance(patch, PatchSet):
        (templates,) = patch.buckets
        return [("template's depth", templates.depth[0]), ("inside", templates.inside[0])]
    if isinstance(patch, PatchViews):
        (seen,), (templates,) = patch.buckets, patch.patches.buckets
        numbers = templates.rows(seen.valid.shape[1]).tolist()
        shown = seen.valid[0].flatten(1).any(dim=1).nonzero()[:, 0].tolist()
        radiance = seen.radiance[0].movedim(1, -1)
        return [(f"view {numbers[view]}", _in_colour(radiance[view])) for view in shown]
    if isinstance(patch, PhotometricPatches):
        (found,) = patch.buckets
        return [
            ("albedo", _in_colour(found.albedo[0])),
            ("normals", normal_colors(found.normals_patch[0])),
            ("confidence", found.confidence[0]),
        ]
    own = _panels(patch.photometric)
    if isinstance(patch, SweptPatches):
        (heights,) = patch.buckets
        known = heights.information[0] > 0
        return [*own, ("height over template", torch.where(known, heights.offset[0], torch.nan))]
    (depths,) = patch.buckets
    return [*own, ("depth", torch.where(depths.valid[0], depths.depth[0], torch.nan))]


def _in_colour(values: Float[Tensor, "height width channel"]) -> Float[Tensor, "height width 3"]:
    """Scale values to the brightest but for one in a hundred, and repeat a single channel."""
    known = values[values > 0].double()
    scale = float(known.quantile(0.99)) if 0 < len(known) < 10_000_000 else 1.0
    return (values / scale).nan_to_num(0).expand(*values.shape[:2], 3)


def _cropped(patch: AnyPatch, panels: list[tuple[str, Tensor]]) -> list[tuple[str, Tensor]]:
    """Leave the padding out: templates of a bucket share one raster."""
    inside = _templates(patch).buckets[0].inside[0]
    rows, columns = (inside.any(dim=axis).nonzero()[:, 0] for axis in (1, 0))
    if not len(rows):
        return panels
    box = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
    return [(title, raster[box]) for title, raster in panels]


def _figure(count: int) -> "Figure":
    # Local, so that importing the package does not load matplotlib; without pyplot nothing global
    # is left behind.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.2 * max(1, count), 2.2), layout="constrained")
    FigureCanvasAgg(figure)
    return figure
