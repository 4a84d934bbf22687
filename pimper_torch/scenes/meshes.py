"""Procedural triangle meshes for ray-traced scenes; the world's z points up."""

import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.records import Mesh
from pimper_torch.scenes.noise import random_waves


def icosphere(subdivisions: int) -> tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"]]:
    """Give a unit sphere of ``20 * 4**subdivisions`` nearly equal faces."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices = torch.tensor(sphere.vertices, dtype=torch.float64)
    return vertices, torch.tensor(sphere.faces, dtype=torch.int64)


def potato(generator: torch.Generator, *, subdivisions: int = 6, bumps: float = 0.006) -> Mesh:
    """Grow a closed, bumpy solid about 2.4 long that rests on ``z = 0``.

    Args:
        generator: Decides its form.
        subdivisions: Of the sphere it starts from; 6 gives 81920 faces.
        bumps: Root mean square of the fine relief, scene units; 0 leaves it smooth.
    """
    sphere, faces = icosphere(subdivisions)
    body = sphere * sphere.new_tensor([1.2, 0.95, 0.85])
    swelling = random_waves(generator, wavelength=2.2, root_mean_square=0.09)
    dents = random_waves(generator, wavelength=0.7, root_mean_square=0.02)
    fine = random_waves(generator, wavelength=0.18, root_mean_square=bumps, num_waves=48)
    body = body * (1 + swelling(body) + dents(body) + fine(body))[:, None]
    body = body - body.new_tensor([0, 0, 1]) * body[:, 2].min()
    return _mesh(body, faces)


def table(half_side: float = 4.0) -> Mesh:
    """Lay a square in the plane ``z = 0``, facing up."""
    corners = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=torch.float64)
    return _mesh(half_side * corners, torch.tensor([[0, 1, 2], [0, 2, 3]]))


def join(*meshes: Mesh) -> Mesh:
    """Put meshes in one, their faces in the order given; only geometry is kept."""
    offsets, count = [], 0
    for mesh in meshes:
        offsets.append(mesh.faces + count)
        count += len(mesh.vertices_world)
    return Mesh(
        vertices_world=torch.cat([mesh.vertices_world for mesh in meshes]),
        faces=torch.cat(offsets),
    )


def _mesh(vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"]) -> Mesh:
    return Mesh(vertices_world=vertices, faces=faces, normals_world=vertex_normals(vertices, faces))
