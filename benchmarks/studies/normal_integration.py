"""Integration of normal maps: error and seconds of each method.

    python benchmarks/studies/normal_integration.py FOLDER [--figure FILE]

FOLDER contains ``diligent/NAME`` with ``normal_map.png, mask.png, K.txt, depth_gt.npz``, and maps
without depth, as the bilateral-integration set distributes them. The error is the mean absolute
error of depth in mm after scaling by the median ratio. ``published`` is bilateral normal
integration (Cao et al. 2022). ``weights from the truth`` solves once, with the robust weights at
the true depth: the remaining error is in the normals themselves. For maps without depth, the angle
between the given normals and those of the surface, over steps that it keeps, shows whether creases
survive.
"""

import argparse
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import matplotlib as mpl
import numpy as np
import torch
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
METHODS = ("weighted", "discontinuities")
# At the true depth, residuals are noise and rounding; larger ones are discontinuities.
TRUE_SCALE_PX = 0.1


def main() -> None:
    """Print two tables, and draw the maps without depth."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--figure", type=Path)
    options = parser.parse_args()
    with_depth(options.folder / "diligent")
    without = sorted(
        path.parent for path in options.folder.glob("*/normal_map.png") if path.parent.is_dir()
    )
    without_depth(without, options.figure)


def with_depth(folder: Path) -> None:
    """Print errors and seconds where the depth is known."""
    print("| method | " + " | ".join(PUBLISHED) + " | mean | without goblet | s, all |")  # noqa: T201
    print("|---|" + "--:|" * (len(PUBLISHED) + 3))  # noqa: T201
    row("published", PUBLISHED, "")
    maps = {name: read_normal_map(folder / name) for name in PUBLISHED}
    for method in METHODS:
        began = time.perf_counter()
        found = [integrate(one, method) for one in maps.values()]
        seconds = time.perf_counter() - began
        errors = {
            name: depth_error(one, result.depth)
            for (name, one), result in zip(maps.items(), found, strict=True)
        }
        row(method, errors, f"{seconds:.1f}")
    errors = {name: depth_error(one, with_true_weights(one)) for name, one in maps.items()}
    row("weights from the truth", errors, "")
    print("\nMean by which true steps leave those of the normals, in thousandths of a pixel:")  # noqa: T201
    for axis, name in enumerate(("right", "down")):
        biases = [1e3 * true_bias(one)[axis] for one in maps.values()]
        print(name + ": " + ", ".join(f"{bias:.1f}" for bias in biases))  # noqa: T201
    print()  # noqa: T201


def row(name: str, errors: Mapping[str, float], seconds: str) -> None:
    """Print one line, with the mean of all objects and of those whose depth normals determine."""
    determined = [error for one, error in errors.items() if one != SPLIT]
    cells = " | ".join(
        f"{error:.3f}" for error in (*errors.values(), fmean(errors.values()), fmean(determined))
    )
    print(f"| {name} | {cells} | {seconds} |", flush=True)  # noqa: T201


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


def true_bias(one: NormalMap) -> list[float]:
    """Return the mean residual of steps to the right and down at the true depth, jumps apart."""
    _, apart, weights = at_the_truth(one)
    return [
        float((weight * residual).sum() / weight.sum())
        for residual, weight in zip(apart, weights, strict=True)
    ]


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


def without_depth(folders: list[Path], figure: Path | None) -> None:
    """Print how well the surface found has the normals given, and draw it."""
    print("| map | method | steps given up % | normals, deg: mean | 99 % | s |")  # noqa: T201
    print("|---|---|--:|--:|--:|--:|")  # noqa: T201
    panels = []
    for folder in folders:
        one = read_normal_map(folder)
        found = {}
        for method in ("weighted", "discontinuities"):
            began = time.perf_counter()
            found[method] = result = integrate(one, method)
            seconds = time.perf_counter() - began
            angle = rotated_by(one, result)
            given_up = torch.nan
            if result.continuity is not None:
                fractions = result.continuity.right, result.continuity.down
                inside = torch.cat([fraction[fraction > 0] for fraction in fractions])
                given_up = 100 * float((inside < 0.25).double().mean())
            print(  # noqa: T201
                f"| {folder.name} | {method} | {given_up:.2f} | {float(angle.mean()):.2f} "
                f"| {float(angle.quantile(0.99)):.2f} | {seconds:.1f} |",
                flush=True,
            )
        panels.append((folder.name, one, found))
    if figure is not None:
        draw(panels, figure)


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


def draw(panels: list[tuple[str, NormalMap, dict[str, IntegratedMap]]], figure: Path) -> None:
    """Draw normals, both surfaces, and the steps given up."""
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
    canvas.savefig(figure, dpi=80)


if __name__ == "__main__":
    main()
