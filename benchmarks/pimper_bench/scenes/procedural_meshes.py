"""Procedural triangle meshes for ray-traced scenes; the world's z axis is up."""

import math
from collections.abc import Callable, Sequence

import torch
import trimesh
from jaxtyping import Float, Int
from skimage.measure import marching_cubes
from torch import Tensor
from torch.nn.functional import normalize

from pimper_bench.scenes.textures import random_waves
from pimper_torch.geometry.surfaces import face_normals, vertex_normals
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import Mesh


def icosphere(subdivisions: int) -> tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"]]:
    """Return a unit sphere of ``20 * 4**subdivisions`` nearly equal faces."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices = torch.tensor(sphere.vertices, dtype=torch.float64)
    return vertices, torch.tensor(sphere.faces, dtype=torch.int64)


def potato(generator: torch.Generator, *, subdivisions: int = 6, bumps: float = 0.006) -> Mesh:
    """Return a closed, bumpy solid about 2.4 long that rests on ``z = 0``.

    Args:
        subdivisions: Of the initial sphere; 6 gives 81920 faces.
        bumps: Root mean square of the fine relief, scene units; 0 for a smooth surface.
    """
    sphere, faces = icosphere(subdivisions)
    body = sphere * sphere.new_tensor([1.2, 0.95, 0.85])
    swelling = random_waves(generator, wavelength=2.2, root_mean_square=0.09)
    dents = random_waves(generator, wavelength=0.7, root_mean_square=0.02)
    fine = random_waves(generator, wavelength=0.18, root_mean_square=bumps, num_waves=48)
    body = body * (1 + swelling(body) + dents(body) + fine(body))[:, None]
    body = body - body.new_tensor([0, 0, 1]) * body[:, 2].min()
    return _mesh(body, faces)


def table(half_side: float = 4.0, cells: int = 1) -> Mesh:
    """Return a square in the plane ``z = 0``, facing up.

    Args:
        cells: Along each side; vertex albedo is stored at their corners.
    """
    side = torch.linspace(-half_side, half_side, cells + 1, dtype=torch.float64)
    y, x = torch.meshgrid(side, side, indexing="ij")
    grid = torch.stack([x, y, torch.zeros_like(x)], dim=-1).reshape(-1, 3)
    return _mesh(grid, _grid_faces(cells + 1, cells + 1))


def lathe(profile: Float[Tensor, "level 2"], around: int = 192) -> Mesh:
    """Rotate a profile about the z axis to a closed solid.

    Args:
        profile: Radius and height of each level, upwards; only the first and the last radius are 0.
    """
    rotation = 2 * torch.pi * torch.arange(around, dtype=profile.dtype) / around
    radius, height = profile[1:-1].unbind(dim=-1)
    rings = torch.stack(
        [
            radius[:, None] * rotation.cos(),
            radius[:, None] * rotation.sin(),
            height[:, None].expand(-1, around),
        ],
        dim=-1,
    ).reshape(-1, 3)
    poles = torch.stack([profile.new_tensor([0, 0, profile[end, 1]]) for end in (0, -1)])
    wall = _grid_faces(len(radius), around + 1)
    wall = wall // (around + 1) * around + wall % (around + 1) % around  # closes the seam
    ring = torch.arange(around)
    following = (ring + 1) % around
    bottom, top = len(rings), len(rings) + 1
    last = len(rings) - around
    below = torch.stack([torch.full_like(ring, bottom), following, ring], dim=1)
    above = torch.stack([torch.full_like(ring, top), last + ring, last + following], dim=1)
    return _mesh(torch.cat([rings, poles]), torch.cat([wall, below, above]))


def moved(
    mesh: Mesh,
    *,
    scale: float = 1.0,
    rotation_deg: float = 0.0,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Mesh:
    """Scale a mesh, rotate it about the z axis, then translate it."""
    cosine, sine = math.cos(math.radians(rotation_deg)), math.sin(math.radians(rotation_deg))
    vertices = mesh.vertices_world
    rotation = vertices.new_tensor([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    normals = mesh.normals_world
    return mesh.replace(
        vertices_world=scale * vertices @ rotation.mT + vertices.new_tensor(shift),
        normals_world=None if normals is None else normals @ rotation.mT,
    )


def push_clear(mesh: Mesh, others: Sequence[Mesh], position: tuple[float, float]) -> Mesh:
    """Move a closed solid to a position on the table, and outward from there until it is free."""
    solid, rest = _Solid(mesh), [_Solid(other) for other in others]
    x, y = position
    shift = solid.points.new_tensor([x, y, 0.0])
    step = 0.02 * shift / shift.norm()
    while any(o.contains(solid.points + shift) or solid.contains(o.points - shift) for o in rest):
        shift = shift + step
    return moved(mesh, shift=(float(shift[0]), float(shift[1]), 0.0))


class _Solid:
    """A closed mesh with a test for points inside."""

    def __init__(self, mesh: Mesh) -> None:
        self.points = mesh.vertices_world.float()
        self._caster = RayCaster(mesh.vertices_world, mesh.faces)
        self._upward = face_normals(mesh.vertices_world, mesh.faces)[:, 2] > 0

    def contains(self, points: Float[Tensor, "point 3"]) -> bool:
        """Return whether any of the points is inside."""
        low, high = self.points.amin(dim=0), self.points.amax(dim=0)
        near = points[((points > low) & (points < high)).all(dim=1)]
        face = self._caster.cast(near, near.new_tensor([0.0, 0.0, 1.0]).expand_as(near)).face
        # A ray from inside leaves through a face that faces its direction.
        return bool(((face >= 0) & self._upward[face]).any())


def join(*meshes: Mesh) -> Mesh:
    """Concatenate meshes, faces in the given order; only vertices and faces are kept."""
    offsets, count = [], 0
    for mesh in meshes:
        offsets.append(mesh.faces + count)
        count += len(mesh.vertices_world)
    return Mesh(
        vertices_world=torch.cat([mesh.vertices_world for mesh in meshes]), faces=torch.cat(offsets)
    )


def _grid_faces(rows: int, columns: int) -> Int[Tensor, "face 3"]:
    """Triangulate the cells of a grid of vertices; with x along columns they face +z."""
    first = (torch.arange(rows - 1)[:, None] * columns + torch.arange(columns - 1)).reshape(-1)
    lower = torch.stack([first, first + 1, first + columns + 1], dim=1)
    upper = torch.stack([first, first + columns + 1, first + columns], dim=1)
    return torch.cat([lower, upper])


def _mesh(vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"]) -> Mesh:
    return Mesh(vertices_world=vertices, faces=faces, normals_world=vertex_normals(vertices, faces))


Level = Callable[[Float[Tensor, "point 3"]], Float[Tensor, " point"]]


def mesh_level_set(
    level: Level,
    lowest: tuple[float, float, float],
    highest: tuple[float, float, float],
    cell: float,
) -> Mesh:
    """Triangulate the zero level set of a function by marching cubes and Newton steps; float64.

    Args:
        level: Negative inside, differentiable, with a gradient of about 1.
        lowest: Corner of a box that contains the solid with a margin.
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
        values = torch.cat([level(block) for block in torch.split(grid, 1 << 20)]).reshape(
            counts.tolist()
        )
    corners, faces, _, _ = marching_cubes(
        values.numpy(), level=0.0, spacing=(cell, cell, cell), gradient_direction="descent"
    )
    vertices = start + torch.from_numpy(corners.astype("float64"))
    # They are within a cell of the surface; each step doubles the digits.
    for _ in range(4):
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
    """Return the union of two solids with a fillet of about this width.

    The polynomial minimum: once differentiable, and exact where they differ by more.
    """
    fraction = ((width - (first - second).abs()) / width).clamp_min(0)
    return torch.minimum(first, second) - fraction**2 * width / 4


def smooth_difference(
    solid: Float[Tensor, " point"], cut: Float[Tensor, " point"], width: float
) -> Float[Tensor, " point"]:
    """Return the difference of two solids with rounded edges."""
    return -smooth_union(-solid, cut, width)


def rounded_cylinder(
    points: Float[Tensor, "point 3"], *, radius: float, low: float, high: float, rounding: float
) -> Float[Tensor, " point"]:
    """Return the signed distance to an upright cylinder about the z axis with rounded edges."""
    # The root has no gradient on the axis.
    across = (points[:, 0] ** 2 + points[:, 1] ** 2 + 1e-12).sqrt() - (radius - rounding)
    along = (points[:, 2] - (low + high) / 2).abs() - ((high - low) / 2 - rounding)
    outside = (across.clamp_min(0) ** 2 + along.clamp_min(0) ** 2 + 1e-18).sqrt()
    return torch.maximum(across, along).clamp_max(0) + outside - rounding


def _with_gradient(
    level: Level, points: Float[Tensor, "point 3"]
) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
    with torch.enable_grad():
        leaf = points.detach().requires_grad_()
        values = level(leaf)
        (gradient,) = torch.autograd.grad(values.sum(), leaf)
    return values.detach(), gradient
