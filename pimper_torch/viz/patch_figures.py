"""Figures of one patch, and of a quantity of all patches in a view."""

from typing import TYPE_CHECKING

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from pimper_torch.geometry.visibility import cast_view
from pimper_torch.records import (
    Cameras,
    CoarseMesh,
    DepthPatches,
    PatchSet,
    PatchViews,
    PhotometricPatches,
    SweptPatches,
)
from pimper_torch.records.shapes import Maps
from pimper_torch.runtime.errors import InputError
from pimper_torch.viz.maps import normal_colors

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

AnyPatch = PatchSet | PatchViews | PhotometricPatches | SweptPatches | DepthPatches


def plot_patch(
    patch: AnyPatch, seen: PatchViews | None = None, sample: tuple[int, int] | None = None
) -> "Figure":
    """Draw the values of one patch in a record, on its template's raster.

    For :class:`PatchViews`, draws every view with valid samples; otherwise albedo, normals (red
    right, green up, blue to the viewer), confidence and heights, if the record has them. With views
    and photometry, also draws the residual of every sample, and a sample's observed and predicted
    radiance in every view in which it is valid.

    Args:
        patch: A record of one patch, such as ``heights[17]``.
        seen: Views on the same patch, such as ``seen[17]``.
        sample: Row and column of the sample whose radiance is drawn; by default the one with the
            largest residual.

    Raises:
        InputError: The record has several patches or none; the views are of a different patch; the
            sample is not valid in any view.
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
        image = raster.detach().float().cpu()
        if image.ndim == 3:
            axes.imshow(image.clamp(0, 1).numpy())
        else:
            figure.colorbar(axes.imshow(image.numpy()), ax=axes, shrink=0.7)
        axes.set_title(title, fontsize="small")
        axes.set_axis_off()
    return figure


def _residual(patch: AnyPatch, seen: PatchViews) -> Maps:
    """Return observed minus predicted gray radiance; NaN where a view has no sample."""
    facets = [item.buckets[0].facet.tolist() for item in (_templates(patch), seen.patches)]
    if isinstance(patch, PatchSet | PatchViews) or facets[0] != facets[1]:
        raise InputError(
            f"plot_patch got a {type(patch).__name__} of facet {facets[0]} and views of facet "
            f"{facets[1]}; needed: photometry of one patch, and views of the same."
        )
    photometric = patch if isinstance(patch, PhotometricPatches) else patch.photometric
    (bucket,), (views,) = photometric.buckets, seen.buckets
    valid = views.valid[0] & bucket.observed[0]
    return torch.where(valid, views.gray[0] - bucket.predicted[0].mean(dim=1), torch.nan).detach()


def _draw_light(
    axes: "Axes", seen: PatchViews, residual: Maps, sample: tuple[int, int] | None
) -> None:
    """Draw a sample's observed and predicted radiance in every view in which it is valid."""
    (views,), (templates,) = seen.buckets, seen.patches.buckets
    if sample is None:
        if not residual.isfinite().any():
            axes.set_title("no valid sample", fontsize="small")
            return
        worst = int(residual.square().nansum(dim=0).argmax())
        sample = worst // residual.shape[2], worst % residual.shape[2]
    row, column = sample
    difference = residual[:, row, column].cpu()
    (valid_views,) = torch.nonzero(difference.isfinite(), as_tuple=True)
    if not len(valid_views):
        raise InputError(
            f"plot_patch: sample {sample} is not valid in any view; choose a different one."
        )
    observed = views.gray[0, valid_views.to(views.valid.device), row, column].detach().cpu()
    numbers = templates.rows(len(difference)).cpu()[valid_views].numpy()
    axes.plot(numbers, observed.numpy(), "k.", label="observed")
    axes.plot(numbers, (observed - difference[valid_views]).numpy(), "C1_", label="predicted")
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
    """Draw one value per facet in a view.

    Args:
        values: One per facet, such as residuals or numbers of views; see :func:`by_facet`.

    Raises:
        InputError: There is not one value for each facet.
    """
    if len(values) != len(coarse.mesh.faces):
        raise InputError(
            f"plot_in_view got {len(values)} values; needed: one for each of "
            f"{len(coarse.mesh.faces)} facets, as returned by `by_facet`."
        )
    face = cast_view(coarse.mesh, cameras, view).face
    visible = values.detach().float().to(face.device)[face.clamp_min(0)]
    image = torch.where(face >= 0, visible, torch.nan).cpu()
    figure = _figure(2)
    axes = figure.add_subplot()
    figure.colorbar(axes.imshow(image.numpy()), ax=axes)
    axes.set_title(title)
    axes.set_axis_off()
    return figure


def by_facet(patches: AnyPatch, name: str) -> Float[Tensor, " face"]:
    """Return a value of every patch, in the order of the facets; NaN for facets without a patch.

    Args:
        name: Of the field, such as ``status``, or of a nested one, ``convergence.residual``, with
            one value per patch.

    Raises:
        InputError: The buckets have no such field, or it does not have one value per patch.
    """
    templates = _templates(patches)
    gathered = torch.full_like(templates.coarse.mesh.faces[:, 0].cpu().float(), torch.nan)
    for template, bucket in zip(templates.buckets, patches.buckets, strict=True):
        value: object = bucket
        for part in name.split("."):
            value = getattr(value, part, None)
        if not isinstance(value, Tensor) or value.shape != template.facet.shape:
            raise InputError(
                f"by_facet: {name} of {type(bucket).__name__} is "
                f"{tuple(value.shape) if isinstance(value, Tensor) else value}; needed: a field "
                "with one value per patch."
            )
        gathered[template.facet.cpu()] = value.detach().float().cpu()
    return gathered


def _panels(patch: AnyPatch) -> list[tuple[str, Tensor]]:
    if isinstance(patch, PatchSet):
        (templates,) = patch.buckets
        return [("template's depth", templates.depth[0]), ("inside", templates.inside[0])]
    if isinstance(patch, PatchViews):
        (observations,), (templates,) = patch.buckets, patch.patches.buckets
        numbers = templates.rows(observations.valid.shape[1]).tolist()
        views = observations.valid[0].flatten(1).any(dim=1).nonzero()[:, 0].tolist()
        radiance = observations.radiance[0].movedim(1, -1)
        return [(f"view {numbers[view]}", _in_colour(radiance[view])) for view in views]
    if isinstance(patch, PhotometricPatches):
        (photometry,) = patch.buckets
        return [
            ("albedo", _in_colour(photometry.albedo[0])),
            ("normals", normal_colors(photometry.normals_patch[0])),
            ("confidence", photometry.confidence[0]),
        ]
    panels = _panels(patch.photometric)
    if isinstance(patch, SweptPatches):
        (heights,) = patch.buckets
        valid = heights.information[0] > 0
        return [*panels, ("height over template", torch.where(valid, heights.offset[0], torch.nan))]
    (depths,) = patch.buckets
    return [*panels, ("depth", torch.where(depths.valid[0], depths.depth[0], torch.nan))]


def _in_colour(values: Float[Tensor, "height width channel"]) -> Float[Tensor, "height width 3"]:
    """Scale values so that their 99th percentile is 1, and repeat a single channel."""
    positive = values[values > 0].double()
    scale = float(positive.quantile(0.99)) if 0 < len(positive) < 10_000_000 else 1.0
    return (values / scale).nan_to_num(0).expand(*values.shape[:2], 3)


def _cropped(patch: AnyPatch, panels: list[tuple[str, Tensor]]) -> list[tuple[str, Tensor]]:
    """Crop the padding: templates of a bucket share one raster."""
    inside = _templates(patch).buckets[0].inside[0]
    rows, columns = (inside.any(dim=axis).nonzero()[:, 0] for axis in (1, 0))
    if not len(rows):
        return panels
    box = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
    return [(title, raster[box]) for title, raster in panels]


def _figure(count: int) -> "Figure":
    # Imported here so that importing the package does not load matplotlib; without pyplot, no
    # global state remains.
    from matplotlib.figure import Figure

    return Figure(figsize=(2.2 * max(1, count), 2.2), layout="constrained")
