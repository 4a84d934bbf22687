"""Integration of a normal map to depth, orthographic or pinhole, with mask, weights and anchors."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from pimper_torch.ground.geometry.pixels import crop_intrinsics
from pimper_torch.ground.shapes import Map, Mask, Matrix3
from pimper_torch.records import Record
from pimper_torch.runtime.errors import InputError
from pimper_torch.single_view.integration.discontinuities import Continuity, find_discontinuities
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

# Weight of steps over pixels without a normal, whose slopes are inpainted: a choice.
_FILLED_WEIGHT = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class IntegratedMap(Record):
    """A surface over a raster.

    Attributes:
        depth: Along z; 0 outside. A component of the mask without known depth has the geometric
            mean 1 under a pinhole, and the mean 0 under parallel rays.
        valid: True where a normal was used; the mask's other pixels are interpolated.
        continuity: The continuous steps between pixels; ``None`` where all are.
    """

    depth: Map
    valid: Mask
    continuity: Continuity | None = None


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
    """Integrate a normal map to depth.

    Args:
        normals: ``height width 3``: x right, y down, z forward into the surface; facing the
            viewer. Of any length; where not finite, zero or facing away the surface is
            interpolated. Like the other rasters, tensors or numpy arrays.
        mask: Pixels of the surface; all if not given.
        intrinsics: Of the pinhole, in pixels from the corner of the top-left one; without it
            rays are parallel.
        spacing: Distance of neighbouring pixels in a row and in a column, under parallel rays.
        weight: Of each normal, that of a known depth being 1; 1 if not given, 0 like not finite.
        known_depth: Depth at some pixels, NaN at the others.
        method: ``"discontinuities"`` preserves depth discontinuities; ``"weighted"`` is least
            squares.

    Raises:
        InputError: Unusable rasters, or normals coded as colours or with z to the viewer.

    Differentiable in normals, weights and known depths; which steps are continuous is constant.

    >>> up = torch.tensor([0.0, 0.0, -1.0]).expand(4, 5, 3)
    >>> float(integrate_normal_map(up).depth.abs().max())
    0.0
    """
    normals = torch.as_tensor(normals)
    mask, weight, known_depth = (
        torch.full(normals.shape[:2], value, device=normals.device)
        if raster is None
        else torch.as_tensor(raster)
        for raster, value in ((mask, True), (weight, 1.0), (known_depth, math.nan))
    )
    _refuse(normals, mask, weight, known_depth, spacing)
    mask = mask.bool()
    intrinsics = None if intrinsics is None else torch.as_tensor(intrinsics).to(normals)
    rows, columns = mask.any(dim=1).nonzero()[:, 0], mask.any(dim=0).nonzero()[:, 0]
    box = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
    frame = (box[1].start, mask.shape[1] - box[1].stop, box[0].start, mask.shape[0] - box[0].stop)
    if intrinsics is not None:
        intrinsics = crop_intrinsics(intrinsics, float(box[1].start), float(box[0].start))
    # The box of the mask, to save time and memory.
    mask, weight, known_depth = mask[box], weight[box], known_depth[box]
    length = normals[box].norm(dim=-1)
    usable = mask & (length > 0) & length.isfinite() & (weight > 0)
    unit = normals[box] / torch.where(usable, length, 1)[..., None]
    unit = torch.where(usable[..., None], unit, torch.nan)
    if intrinsics is None:
        steps = orthographic_steps(unit, mask, spacing)
    else:
        steps = perspective_steps(unit, mask, intrinsics)
    continuity = None
    anchor, unknown = _known(known_depth, mask, steps, intrinsics)
    reliability = torch.where(steps.valid, weight.double(), 0)
    least = torch.where(steps.reliable, at_both_ends(torch.minimum, reliability), _FILLED_WEIGHT)
    weights = at_both_ends(torch.logical_and, steps.inside) * least / steps.unit**2
    if method == "discontinuities":
        continuity = find_discontinuities(steps, weights, anchor, unknown)
        weights = weights * joined(continuity.right, continuity.down)
        continuity = continuity.replace(
            right=pad(continuity.right, frame), down=pad(continuity.down, frame)
        )
    system = RasterSystem(*steps.split(weights), anchor)
    found = system.fit_steps(*steps.target, unknown)
    depth = torch.where(mask, found if intrinsics is None else found.exp(), 0)
    return IntegratedMap(
        depth=pad(depth.to(normals), frame),
        valid=pad(steps.valid & mask, frame),
        continuity=continuity,
    )


def _known(depth: Map, mask: Mask, steps: Steps, intrinsics: Matrix3 | None) -> tuple[Map, Map]:
    given = depth.isfinite() & mask
    if intrinsics is not None and bool((depth[given] <= 0).any()):
        raise InputError(
            f"known_depth has {int((depth[given] <= 0).sum())} values that are not positive; "
            "under a pinhole all must be. Mark pixels of unknown depth with NaN."
        )
    safe = torch.where(given, depth.double(), 1)
    unknown = safe if intrinsics is None else safe.log()
    return given.double() / (steps.units[0] * steps.units[1]), unknown


def _refuse(
    normals: Tensor, mask: Tensor, weight: Tensor, known: Tensor, spacing: tuple[float, float]
) -> None:
    """Refuse unusable rasters, and normals that are coded as colours or face away."""
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
        raise InputError("mask has no pixel; at least one must be inside.")
    if not all(0 < step < math.inf for step in spacing):
        raise InputError(f"spacing is {spacing}; both distances must be above 0.")
    some = normals.detach()[mask.bool()]
    some = some[some.isfinite().all(dim=-1) & (some != 0).any(dim=-1)]
    axes = "needed: x right, y down, z into the surface, n_z < 0 where it faces the viewer"
    if len(some) > 1 and bool(((some >= 0) & (some <= 1)).all()):
        raise InputError(
            f"normals lie in [0, 1], as colours do: decode them as 2 n - 1 first; {axes}."
        )
    away = float((some[:, 2] > 0).float().mean())
    if away > 0.5:
        raise InputError(
            f"normals: {away:.0%} of them have z towards the viewer, as OpenGL's do, whose y "
            f"points up, too: negate y and z; {axes}."
        )
