r"""Linear finite elements on triangle meshes: Laplacian and mass.

A function is given by its values at the vertices and linear on every face. With :math:`G` its
gradient, :math:`A` the areas of the faces and :math:`w` their weights, the Laplacian is
:math:`L = G^T A\, w\, G`: a graph Laplacian in which an edge weighs half the cotangents of its
opposite angles. The least-squares fit of heights to slopes :math:`p`,
:math:`\min \int w |\nabla z - p|^2`, is :math:`L z = G^T A\, w\, p`.

Source: Dziuk, in Partial Differential Equations and Calculus of Variations, 1988.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.records.shapes import Faces, PerVertex, Vertices


@dataclass(frozen=True, slots=True, kw_only=True)
class Elements:
    """Linear elements on the faces of a mesh.

    Attributes:
        opposite: Edge opposite to each corner. Rotated by 90 degrees into the face, it is the
            gradient of the function with 1 there and 0 at the other corners, times twice the area.
        count: Number of vertices.
    """

    faces: Faces
    opposite: Float[Tensor, "face 3 3"]
    area: Float[Tensor, " face"]
    count: int


def elements(vertices: Vertices, faces: Faces) -> Elements:
    """Compute the elements of a mesh; differentiable, in the dtype of the vertices."""
    corners = vertices[faces]
    opposite = corners.roll(-2, dims=1) - corners.roll(-1, dims=1)
    area = face_normals(vertices, faces).norm(dim=-1) / 2
    return Elements(faces=faces, opposite=opposite, area=area, count=len(vertices))


def cotangent_laplacian(
    mesh: Elements, weight: Float[Tensor, " face"], min_shape: float = 0.0
) -> tuple[Int[Tensor, " entry"], Int[Tensor, " entry"], Float[Tensor, " entry"]]:
    r"""Return the entries of :math:`\int w \nabla \varphi_i \cdot \nabla \varphi_j`.

    Args:
        min_shape: Lower bound of a face's area, as a fraction of its longest edge squared: the
            cotangents of needles would otherwise dominate the condition number.

    Returns:
        Rows, columns and values; duplicate entries add up. Positive semidefinite: constants of a
        connected component are in the null space. Differentiable in weights and vertices.
    """
    longest = mesh.opposite.square().sum(-1).amax(dim=1)
    shape = torch.maximum(mesh.area, min_shape * longest)
    blocks = (weight / (4 * shape))[:, None, None] * (mesh.opposite @ mesh.opposite.mT)
    rows = mesh.faces[:, :, None].expand_as(blocks)
    cols = mesh.faces[:, None, :].expand_as(blocks)
    return rows.flatten(), cols.flatten(), blocks.flatten()


def lumped_mass(mesh: Elements, density: Float[Tensor, " face"]) -> PerVertex:
    """Return the mass of each vertex: a third of that of every face around it."""
    fraction = (mesh.area * density / 3)[:, None].expand(-1, 3)
    return fraction.new_zeros(mesh.count).index_add(0, mesh.faces.flatten(), fraction.flatten())
