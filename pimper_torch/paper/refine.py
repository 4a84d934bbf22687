r"""Refinement of the height fields of all patches to one joined surface.

.. math:: E(S) = \int \lambda (1 - G) |\cup S_\mu - S|^2 + G |\nabla S|^2

over the flat facets, in linear finite elements on the subdivided mesh: lumped masses, cotangents,
and G averaged over each face. S is the position of every vertex, so the three coordinates are three
right-hand sides of one system.
"""

import torch
from torch.nn.functional import normalize

from pimper_torch.geometry.finite_elements import cotangent_laplacian, elements, lumped_mass
from pimper_torch.geometry.subdivision import Subdivision, subdivide
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.geometry.topology import face_edges
from pimper_torch.linalg.continuation import about_mean
from pimper_torch.linalg.sums import average
from pimper_torch.linalg.systems import solutions
from pimper_torch.paper.paper_config import RefineConfig
from pimper_torch.records import Convergence, DepthPatches, StopCause, Surface
from pimper_torch.records.shapes import PerFacet, Scalars, Vectors, VertexMask, Vertices
from pimper_torch.stages.fusion.blend import blend_patches, ray_directions, vertex_spacing
from pimper_torch.stages.stage import Stage


def seam_weight(barycentric: Vectors) -> Scalars:
    r"""Return G, which is 0 at the centre of a facet and increases towards its seams.

    :math:`G = \frac12 \sqrt{|a - b| + |a - c| + |c - b|}` of the barycentric coordinates.

    >>> corner, edge, centre = [1.0, 0, 0], [0.5, 0.5, 0], [1 / 3] * 3
    >>> seam_weight(torch.tensor([corner, edge, centre]))
    tensor([0.7071, 0.5000, 0.0000])
    """
    return (barycentric - barycentric.roll(1, dims=-1)).abs().sum(dim=-1).sqrt() / 2


class Refine(Stage):
    """Join the patches and smooth their seams, keeping the centre of every facet.

    The energy over the subdivided mesh takes one sparse factorization for three right-hand sides.
    :mod:`~pimper_torch.stages.fusion.blend` computes the union. Vertices without a supporting patch
    are filled by the smoothness term and have information 0.

    Differentiable in depth, photometric normals, albedo and information; the coarse mesh and
    the templates are constants.
    """

    kept_as = Surface

    def __init__(self, config: RefineConfig | None = None) -> None:
        super().__init__()
        self.config = config or RefineConfig()

    def forward(self, depths: DepthPatches) -> Surface:
        """Return the surface refined from the union of all patches.

        The residual of its convergence is the root mean square distance between the union and the
        surface, in scene units. Without any valid height field, as with one light for all views,
        the surface is that of the facets with smoothed seams, and information is 0.
        """
        patches = depths.patches
        mesh = patches.coarse.mesh
        spacing = vertex_spacing(patches, 1.0)
        subdivision = subdivide(mesh.vertices_world.detach(), mesh.faces, spacing)
        directions = ray_directions(subdivision, patches.coarse).detach()
        blend = blend_patches(depths, subdivision, directions, torch.inf)
        if not bool(blend.supported.any()):
            blend = blend.replace(supported=torch.ones_like(blend.supported))
        points = subdivision.points + blend.heights[:, None] * directions
        radius = self.config.smoothing_radius_samples
        refined = smooth_seams(subdivision, points, blend.supported, spacing, radius)
        vertices = refined.to(points)
        geometric = normalize(vertex_normals(vertices, subdivision.faces), dim=-1)
        photometric = blend.seen & (blend.normals_world.detach().norm(dim=-1) > 0.5)
        moves = (refined - points.double())[blend.supported].detach()
        return Surface(
            vertices_world=vertices,
            faces=subdivision.faces,
            facet=subdivision.facet,
            barycentric=subdivision.barycentric,
            normals_world=torch.where(photometric[:, None], blend.normals_world, geometric),
            albedo=about_mean(blend.albedo, blend.observed, face_edges(subdivision.faces)[0]),
            information=blend.normal_information,
            height_information=blend.offset_information,
            convergence=Convergence(
                iterations=torch.ones(1, dtype=torch.long, device=points.device),
                residual=average(moves.square().sum(dim=-1)).sqrt()[None].to(points),
                cause=torch.full((1,), int(StopCause.CONVERGED), device=points.device),
            ),
        )


def smooth_seams(
    subdivision: Subdivision,
    points: Vertices,
    supported: VertexMask,
    spacing: PerFacet,
    radius: float,
) -> Vertices:
    """Return vertices that minimize the energy, in float64 and differentiable in ``points``.

    The normal equations are ``(M + L) S = M (union)``, M the lumped mass and L the Laplacian.

    Args:
        points: The union of the patches at each vertex.
        supported: True where the union is defined. Elsewhere the mass is nearly zero.
        radius: Smoothing radius, in spacings; see :class:`RefineConfig`.
    """
    fidelity = (radius * spacing.double()) ** -2
    weights = seam_weight(subdivision.barycentric.double())
    mesh = elements(subdivision.points.detach().double(), subdivision.faces)
    mass = lumped_mass(mesh, fidelity[subdivision.face_facet])
    # A little mass ties unsupported vertices to the flat facets, so the system is definite.
    mass = mass * (1 - weights) * torch.where(supported, 1, 1e-9)
    seams = weights[subdivision.faces].mean(dim=1)
    rows, cols, values = cotangent_laplacian(mesh, seams, 1e-4)  # needles count as wider
    diagonal = torch.arange(mesh.count, device=mass.device)
    (solution,) = solutions(
        torch.cat([rows, diagonal]),
        torch.cat([cols, diagonal]),
        torch.cat([values, mass]),
        mass[:, None] * points.double(),
        what="the refinement",
    )
    return solution
