"""Integration of a normal map to depth: parallel or pinhole rays, mask, weights, known depths."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from pimper_torch.geometry.pixels import crop_intrinsics
from pimper_torch.records import Record
from pimper_torch.records.shapes import Map, Mask, Matrix3, VectorMap
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.torch_settings import isolated
from pimper_torch.single_view.integration.discontinuities import (
    ContinuousSteps,
    find_discontinuities,
)
from pimper_torch.single_view.integration.raster_system import RasterSystem
from pimper_torch.single_view.integration.steps import (
    Steps,
    at_both_ends,
    joined,
    orthographic_steps,
    perspective_steps,
)

Raster = Tensor | np.ndarray
Integration = Literal["discontinuities", "weighted"]

# Weight of steps over pixels without a normal, whose slopes are inpainted; chosen by hand.
_FILLED_WEIGHT = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class IntegratedMap(Record):
    """Depth map of a surface.

    Attributes:
        depth: Depth along z; 0 outside. A component of the mask without known depth has the
            geometric mean 1 for a pinhole camera, and the mean 0 for parallel rays.
        valid: True where a normal was used; the mask's other pixels are interpolated.
        continuity: The continuous steps between pixels; ``None`` if all are.
    """

    depth: Map
    valid: Mask
    continuity: ContinuousSteps | None = None


@isolated
def integrate_normal_map(
    normals: Raster,
    mask: Raster | None = None,
    *,
    intrinsics: Raster | None = None,
    spacing: tuple[float, float] = (1.0, 1.0),
    weight: Raster | None = None,
    known_depth: Raster | None = None,
    method: Integration = "discontinuities",
) -> IntegratedMap:
    """Return the depth of a normal map.

    Args:
        normals: ``height width 3``: x right, y down, z forward into the surface; facing the
            viewer, of any length. The surface is interpolated where they are not finite, zero or
            facing away. Rasters are tensors or NumPy arrays.
        mask: Pixels of the surface; all by default.
        intrinsics: Of a pinhole, in pixels from the top-left corner; by default rays are parallel.
        spacing: Distance of neighbouring pixels in a row and in a column, for parallel rays.
        weight: Of each normal relative to a known depth, by default 1; with 0 it is ignored.
        known_depth: Depth at known pixels, NaN elsewhere.
        method: ``"discontinuities"`` preserves them in depth; ``"weighted"`` is least squares.

    Raises:
        InputError: Unusable rasters, or normals encoded as colours or with z to the viewer.

    Differentiable in normals, weights and known depths; which steps are continuous is constant.

    >>> up = torch.tensor([0.0, 0.0, -1.0]).expand(4, 5, 3)
    >>> float(integrate_normal_map(up).depth.abs().max())
    0.0
    """
    normals = normals if isinstance(normals, Tensor) else torch.as_tensor(normals)
    mask, weight, known_depth = (
        torch.full(normals.shape[:2], value, device=normals.device)
        if raster is None
        else torch.as_tensor(raster, device=normals.device)
        for raster, value in ((mask, True), (weight, 1.0), (known_depth, math.nan))
    )
    _refuse(normals, mask, weight, known_depth, spacing)
    # Only the bounding box of the mask, to save time and memory.
    box, frame = _object_box(mask.bool())
    mask, weight = mask[box].bool(), weight[box]
    if intrinsics is not None:
        whole = torch.as_tensor(intrinsics).to(normals)
        intrinsics = crop_intrinsics(whole, float(box[1].start), float(box[0].start))
    unit = _unit(normals[box], mask & (weight > 0))
    if intrinsics is None:
        steps = orthographic_steps(unit, mask, spacing)
    else:
        steps = perspective_steps(unit, mask, intrinsics)
    known_weight, unknown = _known_pixels(known_depth[box], mask, steps, intrinsics)
    solution, continuity = _solved(steps, weight, known_weight, unknown, method)
    if continuity is not None:
        right, down = pad(continuity.right, frame), pad(continuity.down, frame)
        continuity = continuity.replace(right=right, down=down)
    depth = torch.where(mask, solution if intrinsics is None else solution.exp(), 0).to(normals)
    valid = steps.valid & mask
    return IntegratedMap(depth=pad(depth, frame), valid=pad(valid, frame), continuity=continuity)


def _object_box(mask: Mask) -> tuple[tuple[slice, slice], tuple[int, ...]]:
    """Return the bounding box of a mask, and the padding that restores the mask's size."""
    rows, columns = mask.any(dim=1).nonzero()[:, 0], mask.any(dim=0).nonzero()[:, 0]
    box = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
    (height, width), (down, across) = mask.shape, box
    return box, (across.start, width - across.stop, down.start, height - down.stop)


def _unit(normals: VectorMap, usable: Mask) -> VectorMap:
    """Return normals of length 1, NaN where they are not usable, zero or not finite."""
    length = normals.norm(dim=-1)
    usable = usable & (length > 0) & length.isfinite()
    unit = normals / torch.where(usable, length, 1)[..., None]
    return torch.where(usable[..., None], unit, torch.nan)


def _solved(
    steps: Steps, weight: Map, known_weight: Map, unknown: Map, method: Integration
) -> tuple[Map, ContinuousSteps | None]:
    """Return the unknown of every pixel, and the continuous steps; ``None`` if all are."""
    reliability = torch.where(steps.valid, weight.double(), 0)
    least = torch.where(steps.reliable, at_both_ends(torch.minimum, reliability), _FILLED_WEIGHT)
    weights = at_both_ends(torch.logical_and, steps.inside) * least / steps.unit**2
    continuity = None
    if method == "discontinuities":
        continuity = find_discontinuities(steps, weights, known_weight, unknown)
        weights = weights * joined(continuity.right, continuity.down)
    system = RasterSystem(*steps.split(weights), known_weight)
    return system.fit_steps(*steps.target, unknown), continuity


def _known_pixels(
    depth: Map, mask: Mask, steps: Steps, intrinsics: Matrix3 | None
) -> tuple[Map, Map]:
    """Return the weight and the unknown, depth or its logarithm, of pixels with known depth."""
    given = depth.isfinite() & mask
    if intrinsics is not None and bool((depth[given] <= 0).any()):
        raise InputError(
            f"known_depth has {int((depth[given] <= 0).sum())} values that are not positive; "
            "needed: positive depths for a pinhole camera. Mark unknown depths with NaN."
        )
    safe = torch.where(given, depth.double(), 1)
    unknown = safe if intrinsics is None else safe.log()
    return given.double() / (steps.units[0] * steps.units[1]), unknown


def _refuse(
    normals: Tensor, mask: Tensor, weight: Tensor, known: Tensor, spacing: tuple[float, float]
) -> None:
    """Refuse unusable rasters, and normals that are encoded as colours or face away."""
    if normals.ndim != 3 or normals.shape[-1] != 3 or not normals.is_floating_point():
        raise InputError(
            f"normals are {str(normals.dtype).removeprefix('torch.')} of shape "
            f"{tuple(normals.shape)}; needed: floating point, height width 3."
        )
    size = tuple(normals.shape[:2])
    for name, raster in {"mask": mask, "weight": weight, "known_depth": known}.items():
        if raster.shape != size:
            shape = tuple(raster.shape)
            raise InputError(f"{name} is {shape}, the normals are {size}; needed: one size.")
    if not bool((weight >= 0).all()):
        count = int((~(weight >= 0)).sum())
        raise InputError(f"weight has {count} values that are negative or NaN; needed: 0 or more.")
    if not bool(mask.any()):
        raise InputError("mask is empty; needed: at least one pixel.")
    if not all(0 < step < math.inf for step in spacing):
        raise InputError(f"spacing is {spacing}; needed: two distances above 0.")
    usable = normals.detach()[mask.bool()]
    usable = usable[usable.isfinite().all(dim=-1) & (usable != 0).any(dim=-1)]
    axes = "needed: x right, y down, z into the surface; n_z < 0 where it faces the viewer"
    if len(usable) > 1 and bool(((usable >= 0) & (usable <= 1)).all()):
        raise InputError(
            f"normals are in [0, 1], which are encoded as colours: decode them as 2 n - 1; {axes}."
        )
    away = float((usable[:, 2] > 0).float().mean())
    if away > 0.5:
        raise InputError(
            f"normals: {away:.0%} have z towards the viewer, as in OpenGL, where y is also up: "
            f"negate y and z; {axes}."
        )
