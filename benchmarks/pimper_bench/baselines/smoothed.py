r"""Baseline: the smoothed coarse mesh, without photometry.

The surface of least bending through the coarse mesh's vertices: with the flat facets as the
domain, the positions S minimise

.. math:: \int |\Delta S|^2 + e \oint |S''|^2 + \frac{w}{e^2} \sum_v |S(v) - V_v|^2

over the subdivided mesh, with e the median edge. The first term is that of a thin plate; it
depends only on lengths within the facets, so it does not preserve creases between them. The
second is the bending of the rim, without which harmonic functions would be free. The last
keeps the vertices near their positions. Linear finite elements: cotangents and lumped masses.

Source: Botsch & Sorkine, On linear variational surface deformation methods, TVCG 14(1), 2008,
for the discrete plate; the rim's term is ours.
"""

import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from torch import Tensor

from pimper_bench.metrics.estimates import Estimate
from pimper_torch.geometry.finite_elements import cotangent_laplacian, elements, lumped_mass
from pimper_torch.geometry.subdivision import Subdivision, subdivide
from pimper_torch.geometry.surfaces import face_normals, side_lengths, vertex_normals
from pimper_torch.geometry.topology import (
    boundary_vertices,
    face_counts,
    face_edges,
    half_edges,
)
from pimper_torch.linalg.sparse import SparseCholesky
from pimper_torch.records import CoarseMesh, Mesh, SparseScene
from pimper_torch.runtime.errors import ReconstructionError
from pimper_torch.stages.stage import Stage

# Vertices of the smooth mesh if its facets are of one size, about twice as many with those of a
# sparse cloud: more vertices would not show more detail.
_NUM_VERTICES = 20_000

# ``w``: on a sphere, a wavy plane and rendered potatoes, 1000 was nearer to the truth than 100, and
# 10000 hardly nearer than 1000.
_FIDELITY = 1000.0

# Rows, columns and values of a sparse matrix.
Entries = tuple[Int[Tensor, " entry"], Int[Tensor, " entry"], Float[Tensor, " entry"]]


class Smoothed(Stage):
    """Smooth the coarse mesh as a thin plate that is held near its vertices.

    Any mesh works, also closed ones and several components. Photographs are not used;
    albedo and lights are unknown. Not differentiable.
    """

    @torch.no_grad()
    def forward(self, scene: SparseScene, coarse: CoarseMesh) -> Estimate:
        """Smooth the mesh; vertex normals are those of the smooth mesh."""
        mesh = coarse.mesh
        if len(mesh.faces) == 0:
            raise ReconstructionError(
                "the coarse mesh has no facets; needed: at least one. Relax the filters of "
                "`triangulate`, or provide a mesh."
            )
        area = face_normals(mesh.vertices_world, mesh.faces).norm(dim=-1).sum() / 2
        # A triangular subdivided mesh with edges s has a vertex on every sqrt(3)/2 s^2.
        spacing = (area / _NUM_VERTICES * 2 / 3**0.5).sqrt()
        subdivision = subdivide(mesh.vertices_world, mesh.faces, spacing.expand(len(mesh.faces)))
        vertices = thin_plate(subdivision, mesh)
        return Estimate(
            mesh=Mesh(
                vertices_world=vertices,
                faces=subdivision.faces,
                normals_world=vertex_normals(vertices, subdivision.faces),
            ),
            names=scene.views.names,
            cameras=scene.cameras,
            reference=scene.views.names[coarse.reference],
        )


def thin_plate(subdivision: Subdivision, mesh: Mesh) -> Float[Tensor, "vertex 3"]:
    """Return the vertex positions of the subdivided mesh on the surface of least bending."""
    points = subdivision.points.double()
    corners = mesh.vertices_world.double()[mesh.faces]
    edge = side_lengths(corners).median()
    rim = boundary_vertices(subdivision.faces, len(points))
    flat = elements(points, subdivision.faces)
    ones = torch.ones_like(flat.area)
    # A sliver's area is set to at least this fraction of its longest edge squared.
    rows, cols, values = cotangent_laplacian(flat, ones, 1e-3)
    mass = lumped_mass(flat, ones)
    keep = torch.where(rim, 0, 1 / mass.sqrt())
    count = len(points)
    grams = [
        _gram((rows, cols, values * keep[rows]), count, count),
        _gram(_rim_differences(subdivision, edge), count, count),
    ]
    (fixed,) = (subdivision.barycentric == 1).any(dim=1).nonzero(as_tuple=True)
    slot = subdivision.barycentric[fixed].argmax(dim=1)
    target = mesh.faces[subdivision.facet[fixed], slot]
    regularization = torch.full_like(mass, _FIDELITY)[target] / edge**2
    diagonal = torch.zeros_like(mass).index_add(0, fixed, regularization)
    rhs = torch.zeros_like(points).index_add(
        0, fixed, regularization[:, None] * mesh.vertices_world.double()[target]
    )
    index = torch.arange(len(points), device=points.device)
    factor = SparseCholesky(
        torch.cat([*(rows for rows, _, _ in grams), index]),
        torch.cat([*(cols for _, cols, _ in grams), index]),
        # 1e-9 of the weight of the vertices keeps unconstrained rims definite.
        torch.cat([*(values for _, _, values in grams), diagonal + 1e-9 * regularization.mean()]),
        size=len(points),
        what="the smoothing of the coarse mesh",
    )
    return factor.solve(rhs + 1e-9 * regularization.mean() * points).to(subdivision.points)


def _gram(
    entries: Entries, num_rows: int, num_columns: int
) -> tuple[Int[Tensor, " product"], Int[Tensor, " product"], Float[Tensor, " product"]]:
    """Return ``B^T B`` of a sparse matrix; duplicate entries are added."""
    rows, cols, values = (entry.cpu().numpy() for entry in entries)
    matrix = coo_array((values, (rows, cols)), shape=(num_rows, num_columns)).tocsr()
    gram = (matrix.T @ matrix).tocoo()
    like = entries[0]
    return (
        torch.from_numpy(gram.row).to(like),
        torch.from_numpy(gram.col).to(like),
        torch.from_numpy(gram.data).to(entries[2]),
    )


def _rim_differences(subdivision: Subdivision, edge: Float[Tensor, ""]) -> Entries:
    """Return the second differences along the border, in the plate's units."""
    _, index = face_edges(subdivision.faces)
    ends = half_edges(subdivision.faces)[face_counts(index)[index.flatten()] == 1]
    count = len(subdivision.points)
    # Every vertex of the rim with one incoming and one outgoing edge has a second difference.
    following = torch.full((count,), -1, device=ends.device).index_put((ends[:, 0],), ends[:, 1])
    preceding = torch.full((count,), -1, device=ends.device).index_put((ends[:, 1],), ends[:, 0])
    degree = torch.bincount(ends.flatten(), minlength=count)
    (centre,) = ((degree == 2) & (following >= 0) & (preceding >= 0)).nonzero(as_tuple=True)
    before, after = preceding[centre], following[centre]
    points = subdivision.points.double()
    back = (points[centre] - points[before]).norm(dim=-1)
    ahead = (points[after] - points[centre]).norm(dim=-1)
    root = (edge * 2 / (back + ahead)).sqrt()
    values = torch.stack([root / back, -root * (1 / back + 1 / ahead), root / ahead])
    columns = torch.stack([before, centre, after])
    return centre.expand(3, -1).flatten(), columns.flatten(), values.flatten()
