"""Integration of normal maps: error and seconds of each method.

``normal_integration/diligent/NAME`` of the shared data has ``normal_map.png, mask.png, K.txt,
depth_gt.npz``, and ``normal_integration/NAME`` maps without depth, as the bilateral-integration set
distributes them. The error is the mean absolute
error of depth in mm after scaling by the median ratio. ``published`` is bilateral normal
integration (Cao et al. 2022). ``weights from the truth`` solves once, with the robust weights at
the true depth: the remaining error is in the normals themselves. For maps without depth, the angle
between the given normals and those of the surface, over steps that it keeps, shows whether creases
survive.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import fmean

import matplotlib as mpl
import numpy as np
import torch
from bench_runs import cpu_seconds
from declared import DATA, Figures, Place, Row, Study, Table, figure, listed
from jaxtyping import Bool, Float
from matplotlib import pyplot as plt
from torch import Tensor
from torch.nn.functional import normalize

from pimper_bench.datasets.diligent import facing_us
from pimper_bench.datasets.raster import intrinsics_from_indices
from pimper_torch.io.decode import decode
from pimper_torch.io.photographs import read_mask
from pimper_torch.paper.integrate import differences
from pimper_torch.single_view.integration.normal_map import IntegratedMap, integrate_normal_map
from pimper_torch.single_view.integration.raster_system import RasterSystem
from pimper_torch.single_view.integration.steps import (
    Steps,
    joined,
    orthographic_steps,
    perspective_steps,
)

PUBLISHED = {"bear": 0.334, "cat": 0.074, "cow": 0.058, "goblet": 9.018, "pot1": 0.635}
# Occluding contours divide it into parts; normals say nothing of their distances.
SPLIT = "goblet"
MAPS = DATA / "normal_integration"
DILIGENT = MAPS / "diligent"
CREASED = ("Fig1_thinker", "Fig4_stripes", "supp_tent", "supp_vase")
METHODS = ("weighted", "discontinuities")
# At the true depth, residuals are noise and rounding; larger ones are discontinuities.
TRUE_SCALE_PX = 0.1


def errors_of(place: Place, method: str) -> Figures:
    """Return the error of each object whose depth is known, with the CPU seconds of a method."""
    maps = {name: read_normal_map(place.photographs(DILIGENT / name)) for name in PUBLISHED}
    began = cpu_seconds()
    if method == "weights from the truth":
        found = [with_true_weights(one) for one in maps.values()]
    else:
        found = [integrate(one, method).depth for one in maps.values()]
    seconds = cpu_seconds() - began
    pairs = zip(maps.items(), found, strict=True)
    return means({name: depth_error(one, depth) for (name, one), depth in pairs}) | {
        "CPU s": seconds
    }


def means(errors: Mapping[str, float]) -> Figures:
    """Add the mean of all objects, and of those whose depth normals determine."""
    determined = [error for name, error in errors.items() if name != SPLIT]
    means = {"mean": fmean(errors.values()), f"without {SPLIT}": fmean(determined)}
    return {**errors, **means}


@dataclass(frozen=True, slots=True, kw_only=True)
class NormalMap:
    """A normal map to integrate, with the known data of its surface.

    Attributes:
        normals: Unit, facing the viewer (``n_z < 0``), camera frame; zero off the mask.
        mask: True on the object.
        intrinsics: ``K`` in our pixels; ``None`` for an orthographic map.
        depth: True depth along the camera's z, millimetres; infinite where unknown.
    """

    normals: Float[Tensor, "height width 3"]
    mask: Bool[Tensor, "height width"]
    intrinsics: Float[Tensor, "3 3"] | None
    depth: Float[Tensor, "height width"] | None


def read_normal_map(folder: Path) -> NormalMap:
    """Read a normal map as the bilateral-integration set distributes it.

    ``normal_map.png`` holds ``(n + 1) / 2`` with y up and z towards the viewer; ``K.txt``, which
    counts pixel centres from 0, and ``depth_gt.npz`` are optional. On the five DiLiGenT objects the
    turned normals agree with those of the true depth to 0.8 to 3.9 degrees in the mean, and with no
    other choice of signs to better than 38.
    """
    mask = read_mask(folder / "mask.png")
    normals = facing_us(decode(folder / "normal_map.png").samples.movedim(0, -1) * 2 - 1)
    K, depth = folder / "K.txt", None
    if (folder / "depth_gt.npz").is_file():
        known = torch.from_numpy(np.load(folder / "depth_gt.npz")["depth_gt"].astype(np.float32))
        depth = torch.where(known.isfinite() & (known > 0), known, torch.inf)
    return NormalMap(
        normals=torch.where(mask[..., None], normals, 0),
        mask=mask,
        intrinsics=intrinsics_from_indices(torch.from_numpy(np.loadtxt(K))) if K.exists() else None,
        depth=depth,
    )


def integrate(one: NormalMap, method: str) -> IntegratedMap:
    """Integrate as a user would."""
    return integrate_normal_map(
        one.normals.double(), one.mask, intrinsics=one.intrinsics, method=method
    )


def depth_error(one: NormalMap, depth: Tensor) -> float:
    """Return the mean absolute error after the scale of the median ratio."""
    assert one.depth is not None
    known = one.mask & depth.isfinite() & one.depth.isfinite()
    ours, true = depth[known].double(), one.depth[known].double()
    return float((ours * (true / ours).quantile(0.5) - true).abs().mean())


def with_true_weights(one: NormalMap) -> Tensor:
    """Solve with the weights that the true depth gives."""
    steps, _, weights = at_the_truth(one)
    return RasterSystem(*weights).fit_steps(*steps.target).exp()


def at_the_truth(one: NormalMap) -> tuple[Steps, list[Tensor], list[Tensor]]:
    """Return the steps wanted, by how many pixels the true depth leaves them, and weights."""
    assert one.depth is not None
    assert one.intrinsics is not None
    steps = perspective_steps(one.normals.double(), one.mask, one.intrinsics)
    unknown = torch.where(one.mask, one.depth.double(), 1).log()
    inside = one.mask[:, 1:] & one.mask[:, :-1], one.mask[1:] & one.mask[:-1]
    residual = joined(*differences(unknown)) / steps.unit - steps.slope
    apart = [
        torch.where(within, part, 0)
        for within, part in zip(inside, steps.split(residual), strict=True)
    ]
    weights = [
        within * (1 + (residual / TRUE_SCALE_PX).square()).pow(-2).clamp_min(1e-6)
        for residual, within in zip(apart, inside, strict=True)
    ]
    return steps, apart, weights


def creases(place: Place, name: str) -> Figures:
    """Return how well the surface of each method has the given normals."""
    one = read_normal_map(place.photographs(MAPS / name))
    figures: Figures = {}
    for method in METHODS:
        result = integrate(one, method)
        angle = rotated_by(one, result)
        figures[f"{method} mean"] = float(angle.mean())
        figures[f"{method} 99 %"] = float(angle.quantile(0.99))
        if result.continuity is not None:
            fractions = result.continuity.right, result.continuity.down
            inside = torch.cat([fraction[fraction > 0] for fraction in fractions])
            figures["rejected"] = 100 * float((inside < 0.25).double().mean())
    return figures


def rotated_by(one: NormalMap, found: IntegratedMap) -> Tensor:
    """Return the angle between the normals given and those of the surface, by its own steps."""
    depth, K = found.depth, one.intrinsics
    unknown = depth if K is None else torch.where(one.mask, depth, 1).log()
    if K is None:
        steps = orthographic_steps(one.normals.double(), one.mask)
    else:
        steps = perspective_steps(one.normals.double(), one.mask, K)
    across, along = steps.split(joined(*differences(unknown)) / steps.unit)
    kept = list(steps.split(steps.reliable))
    if found.continuity is not None:
        kept[0] = kept[0] & (found.continuity.right > 0.25)
        kept[1] = kept[1] & (found.continuity.down > 0.25)
    slope = torch.stack([_mean_of_kept(across, kept[0], 1), _mean_of_kept(along, kept[1], 0)], -1)
    own = normalize(torch.cat([slope, -torch.ones_like(slope[..., :1])], dim=-1), dim=-1)
    given = normalize(torch.cat([steps.slopes, -torch.ones_like(slope[..., :1])], dim=-1), dim=-1)
    cosine = (own * given).sum(dim=-1).clamp(-1, 1)
    seen = slope.isfinite().all(dim=-1) & steps.valid
    return cosine[seen].acos().rad2deg()


def _mean_of_kept(steps: Tensor, kept: Tensor, axis: int) -> Tensor:
    """Average the steps on both sides of a pixel that the surface takes; NaN without any."""
    total = torch.where(kept, steps, 0)
    shape = list(total.shape)
    shape[axis] = 1
    edge, none = total.new_zeros(shape), kept.new_zeros(shape)
    summed = torch.cat([total, edge], dim=axis) + torch.cat([edge, total], dim=axis)
    count = torch.cat([kept, none], dim=axis).int() + torch.cat([none, kept], dim=axis).int()
    return summed / torch.where(count > 0, count, torch.nan)


def draw(place: Place, path: Path) -> None:
    """Draw the maps without depth: normals, both surfaces, and the steps given up."""
    maps = {name: read_normal_map(MAPS / name) for name in CREASED}
    panels = [
        (name, one, {method: integrate(one, method) for method in METHODS})
        for name, one in maps.items()
    ]
    mpl.use("Agg")
    names = "normals", "least squares", "discontinuities", "steps given up"
    canvas, axes = plt.subplots(len(panels), 4, figsize=(10, 2.2 * len(panels)), squeeze=False)
    for line, (name, one, found) in zip(axes, panels, strict=True):
        line[0].imshow(torch.where(one.mask[..., None], (one.normals + 1) / 2, 1).clamp(0, 1))
        line[0].set_ylabel(name)
        torn = found["discontinuities"]
        for place, method in ((1, "weighted"), (2, "discontinuities")):
            line[place].imshow(
                torch.where(one.mask, found[method].depth, torch.nan), cmap="viridis"
            )
        assert torn.continuity is not None
        lost = torch.zeros_like(torn.depth)
        lost[:, 1:] += (torn.continuity.right < 0.25) & (torn.continuity.right > 0)
        lost[1:] += (torn.continuity.down < 0.25) & (torn.continuity.down > 0)
        line[3].imshow(torch.where(one.mask, lost.clamp_max(1), torch.nan), cmap="magma")
        for panel in line:
            panel.set_xticks([])
            panel.set_yticks([])
    for panel, title in zip(axes[0], names, strict=True):
        panel.set_title(title, fontsize=9)
    canvas.tight_layout()
    canvas.savefig(path, dpi=80)


ERRORS = [figure(name, name, 3) for name in (*PUBLISHED, "mean", f"without {SPLIT}")]
METHOD_ROWS = (*METHODS, "weights from the truth")

STUDY = Study(
    name="normal_integration",
    rows={
        ("depth", "published"): Row(measure=lambda place: means(PUBLISHED)),
        **{
            ("depth", method): Row(measure=partial(errors_of, method=method))
            for method in METHOD_ROWS
        },
        **{("creases", name): Row(measure=partial(creases, name=name)) for name in CREASED},
    },
    tables=[
        Table(
            name="integration",
            document="benchmarks/README.md",
            lines=listed(["method"], [*ERRORS, figure("CPU s", "CPU s", 1)]),
            part="depth",
        ),
        Table(
            name="creases",
            document="benchmarks/README.md",
            lines=listed(
                ["map"],
                [
                    *(
                        figure(f"{method}: {told} °", f"{method} {told}")
                        for method in METHODS
                        for told in ("mean", "99 %")
                    ),
                    figure("steps rejected, %", "rejected"),
                ],
            ),
            part="creases",
        ),
    ],
    draw=draw,
    picture="notebooks/images/integration.jpg",
)
