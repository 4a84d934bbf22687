"""Solids as signed functions with bounds, to be joined, cut and meshed; float64."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_bench.scenes.procedural_meshes import (
    Level,
    mesh_level_set,
    smooth_difference,
    smooth_union,
)
from pimper_bench.scenes.textures import Waves
from pimper_torch.records import Mesh

Place = Sequence[float] | Float[Tensor, " 3"]
_TINY = 1e-12  # under roots, whose gradient is infinite at 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Solid:
    """A solid.

    Attributes:
        level: Negative inside, with a gradient of about 1 near the surface.
        lowest: Corner of a box that contains the solid.
        highest: The opposite corner.
    """

    level: Level
    lowest: Float[Tensor, " 3"]
    highest: Float[Tensor, " 3"]


def capsule(start: Place, end: Place, radius: float, end_radius: float | None = None) -> Solid:
    """Return the points near a segment, within a radius that changes linearly along it."""
    a, b = _vector(start), _vector(end)
    end_radius = radius if end_radius is None else end_radius
    along = b - a

    def level(points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        fraction = ((points - a) @ along / (along @ along + _TINY)).clamp(0, 1)
        away = points - a - fraction[:, None] * along
        return _norm(away) - (radius + (end_radius - radius) * fraction)

    return Solid(
        level=level,
        lowest=torch.minimum(a - radius, b - end_radius),
        highest=torch.maximum(a + radius, b + end_radius),
    )


def ellipsoid(centre: Place, radii: Place, rotation: Float[Tensor, "3 3"] | None = None) -> Solid:
    """Return an ellipsoid; the columns of the rotation are its axes."""
    middle, r = _vector(centre), _vector(radii)
    axes = torch.eye(3, dtype=torch.float64) if rotation is None else rotation

    def level(points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        local = (points - middle) @ axes / r
        relative = _norm(local)
        return relative * (relative - 1) / _norm(local / r)  # its first-order distance

    half = ((axes * r) ** 2).sum(dim=1).sqrt()
    return Solid(level=level, lowest=middle - half, highest=middle + half)


def rounded_box(
    centre: Place, half: Place, rounding: float, rotation: Float[Tensor, "3 3"] | None = None
) -> Solid:
    """Return a box with round edges; the columns of the rotation are its axes.

    Args:
        half: Half its sides, the rounding included.
    """
    middle, h = _vector(centre), _vector(half)
    axes = torch.eye(3, dtype=torch.float64) if rotation is None else rotation

    def level(points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        beyond = ((points - middle) @ axes).abs() - (h - rounding)
        return _norm(beyond.clamp_min(0)) + beyond.amax(dim=1).clamp_max(0) - rounding

    reach = axes.abs() @ h
    return Solid(level=level, lowest=middle - reach, highest=middle + reach)


def ring(centre: Place, radius: float, thickness: float, rotation: Float[Tensor, "3 3"]) -> Solid:
    """Return a torus about the third column of the rotation.

    Args:
        radius: Of its centre line.
        thickness: Radius of its cross section.
    """
    middle = _vector(centre)

    def level(points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        local = (points - middle) @ rotation
        outward = _norm(local[:, :2]) - radius
        return (outward**2 + local[:, 2] ** 2 + _TINY).sqrt() - thickness

    reach = radius + thickness
    return Solid(level=level, lowest=middle - reach, highest=middle + reach)


def joined(solids: Sequence[Solid], width: float) -> Solid:
    """Return the union of solids with fillets of about this width."""
    return Solid(
        level=lambda points: reduce(
            lambda first, second: smooth_union(first, second, width),
            [solid.level(points) for solid in solids],
        ),
        lowest=torch.stack([solid.lowest for solid in solids]).amin(dim=0),
        highest=torch.stack([solid.highest for solid in solids]).amax(dim=0),
    )


def without(solid: Solid, hole: Solid, width: float) -> Solid:
    """Return a solid with a hole with round edges."""
    return Solid(
        level=lambda points: smooth_difference(solid.level(points), hole.level(points), width),
        lowest=solid.lowest,
        highest=solid.highest,
    )


def bumped(solid: Solid, waves: Waves, margin: float) -> Solid:
    """Return a solid with bumps that are lower than the margin."""
    return Solid(
        level=lambda points: solid.level(points) + waves(points).clamp(-margin, margin),
        lowest=solid.lowest - margin,
        highest=solid.highest + margin,
    )


def meshed(solid: Solid, cells: int) -> Mesh:
    """Triangulate a solid with this number of cells along its longest side."""
    cell = float((solid.highest - solid.lowest).amax()) / cells
    lowest, highest = (solid.lowest - 2 * cell).tolist(), (solid.highest + 2 * cell).tolist()
    return mesh_level_set(solid.level, tuple(lowest), tuple(highest), cell)


def _vector(values: Place) -> Float[Tensor, " 3"]:
    return torch.as_tensor(values, dtype=torch.float64)


def _norm(vectors: Float[Tensor, "point axis"]) -> Float[Tensor, " point"]:
    return ((vectors * vectors).sum(dim=1) + _TINY).sqrt()
