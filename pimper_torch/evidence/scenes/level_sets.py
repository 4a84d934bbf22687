"""Solids given by a function of space that is negative inside."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from skimage.measure import marching_cubes
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.records import Mesh

Level = Callable[[Float[Tensor, "point 3"]], Float[Tensor, " point"]]

_SLAB = 1 << 20  # points at once
_NEWTON_STEPS = 4  # from within a cell of the surface; each doubles the digits


def mesh_level_set(
    level: Level,
    lowest: tuple[float, float, float],
    highest: tuple[float, float, float],
    cell: float,
) -> Mesh:
    """Triangulate where a function is zero, by marching cubes; float64.

    The vertices are then moved on to the surface exactly, and get the function's gradient
    for a normal.

    Args:
        level: Negative inside, differentiable, with a gradient of about 1.
        lowest: Corner of a box that holds the solid with room to spare.
        cell: Side of the cubes, scene units.
    """
    start = torch.tensor(lowest, dtype=torch.float64)
    counts = ((torch.tensor(highest, dtype=torch.float64) - start) / cell).ceil().long() + 1
    axes = [
        corner + cell * torch.arange(int(count), dtype=torch.float64)
        for corner, count in zip(lowest, counts, strict=True)
    ]
    grid = torch.cartesian_prod(*axes)
    with torch.no_grad():
        values = torch.cat([level(part) for part in torch.split(grid, _SLAB)]).reshape(
            counts.tolist()
        )
    found, faces, _, _ = marching_cubes(
        values.numpy(), level=0.0, spacing=(cell, cell, cell), gradient_direction="descent"
    )
    vertices = start + torch.from_numpy(found.astype("float64"))
    for _ in range(_NEWTON_STEPS):
        value, gradient = _with_gradient(level, vertices)
        step = value / (gradient * gradient).sum(dim=-1)
        vertices = vertices - step[:, None] * gradient
    return Mesh(
        vertices_world=vertices,
        faces=torch.from_numpy(faces.astype("int64")),
        normals_world=normalize(_with_gradient(level, vertices)[1], dim=-1),
    )


def smooth_union(
    first: Float[Tensor, " point"], second: Float[Tensor, " point"], width: float
) -> Float[Tensor, " point"]:
    """Join two solids with a fillet of about this width where they meet.

    The polynomial minimum: once differentiable, and exact where they differ by more.
    """
    fraction = ((width - (first - second).abs()) / width).clamp_min(0)
    return torch.minimum(first, second) - fraction**2 * width / 4


def smooth_difference(
    solid: Float[Tensor, " point"], cut: Float[Tensor, " point"], width: float
) -> Float[Tensor, " point"]:
    """Cut one solid out of another, rounding the edges."""
    return -smooth_union(-solid, cut, width)


def rounded_cylinder(
    points: Float[Tensor, "point 3"],
    *,
    radius: float,
    low: float,
    high: float,
    rounding: float,
) -> Float[Tensor, " point"]:
    """Return the signed distance to an upright cylinder about the z axis with round edges."""
    # Kept off the axis, where the root has no gradient.
    across = (points[:, 0] ** 2 + points[:, 1] ** 2 + 1e-12).sqrt() - (radius - rounding)
    along = (points[:, 2] - (low + high) / 2).abs() - ((high - low) / 2 - rounding)
    outside = (across.clamp_min(0) ** 2 + along.clamp_min(0) ** 2 + 1e-18).sqrt()
    return torch.maximum(across, along).clamp_max(0) + outside - rounding


def _with_gradient(
    level: Level, points: Float[Tensor, "point 3"]
) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
    with torch.enable_grad():
        at = points.detach().requires_grad_()
        values = level(at)
        (gradient,) = torch.autograd.grad(values.sum(), at)
    return values.detach(), gradient
