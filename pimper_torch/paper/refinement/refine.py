"""Refinement: height field of all patches in, one joined surface out."""

from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.config import Range, require_ranges
from pimper_torch.fusion.blend import Blend, blend_patches, ray_directions, vertex_spacing
from pimper_torch.fusion.continuation import about_mean
from pimper_torch.geometry.subdivision import Subdivision, subdivide
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.geometry.topology import face_edges
from pimper_torch.linalg.sums import average
from pimper_torch.linalg.systems import solutions
from pimper_torch.paper.refinement.energy import assemble
from pimper_torch.records import Convergence, DepthPatches, StopCause, Surface
from pimper_torch.stage import Stage


@dataclass(frozen=True, slots=True, kw_only=True)
class RefineConfig:
    """How much seams are smoothed.

    Attributes:
        smoothing_radius_samples: ``r``, in vertices of the surface: lambda is
            ``1 / (r * spacing)^2``, the inverse square of a length. Where G is constant, a
            wave of length ``w`` keeps ``1 / (1 + (2 pi R / w)^2)`` of its height, with
            ``R = r sqrt(G / (1 - G))`` vertices: half of it at ``w = 2 pi R``. R is ``r`` on
            the centre of an edge, 1.55 ``r`` at a vertex of the coarse mesh, nothing in the
            centre of a facet. Twice the radius is a quarter of lambda. The notebook
            ``08_refinement`` shows it.
    """

    smoothing_radius_samples: Annotated[float, Range(above=0, most=65_535)] = 2.0

    def __post_init__(self) -> None:
        require_ranges(self)


class Refine(Stage):
    r"""Join the patches and smooth their seams, keeping the centre of every facet.

    Minimises :math:`\int \lambda (1-G) |\cup S_\mu - S|^2 + G |\nabla S|^2` over the subdivided
    mesh of the coarse mesh, with places S as unknowns: one sparse factorization, three right-hand
    sides. See :mod:`~pimper_torch.paper.refinement.energy` for the discretisation, and
    :mod:`~pimper_torch.fusion.blend` for the union. Vertices that no patch supports are filled by
    the smoothness term and have information 0.

    Differentiable in depth, photometric normals, albedo and information; the coarse mesh and
    the templates are constants.
    """

    def __init__(self, config: RefineConfig | None = None) -> None:
        super().__init__()
        self.config = config or RefineConfig()

    def forward(self, depths: DepthPatches) -> Surface:
        """Refine the union of all patches.

        The convergence's residual is the root mean square distance between the union and
        the surface, in scene units, after one solve.

        Where no patch has valid height field anywhere, as under one light for all views, the
        surface is that of the facets, its seams smoothed, with information 0.
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
        apart = (refined - points.double())[blend.supported].detach()
        return Surface(
            vertices_world=vertices,
            faces=subdivision.faces,
            facet=subdivision.facet,
            barycentric=subdivision.barycentric,
            normals_world=_normals(blend, vertices, subdivision),
            albedo=about_mean(blend.albedo, blend.observed, face_edges(subdivision.faces)[0]),
            information=blend.normal_information,
            height_information=blend.offset_information,
            convergence=Convergence(
                iterations=torch.ones(1, dtype=torch.long, device=points.device),
                residual=average(apart.square().sum(dim=-1)).sqrt()[None].to(points),
                cause=torch.full((1,), int(StopCause.CONVERGED), device=points.device),
            ),
        )


def smooth_seams(
    subdivision: Subdivision,
    points: Float[Tensor, "vertex 3"],
    supported: Bool[Tensor, " vertex"],
    spacing: Float[Tensor, " facet"],
    radius: float,
) -> Float[Tensor, "vertex 3"]:
    """Minimise the energy over the subdivided mesh.

    Args:
        points: The union: where the patches have each vertex.
        supported: Where they have it anywhere.
        spacing: Of each facet's vertices, scene units.
        radius: Of the smoothing, in spacings; see :class:`RefineConfig`.

    Returns:
        The places in float64.

    Differentiable in ``points``; see :class:`Refine`.
    """
    fidelity = (radius * spacing.double()) ** -2
    system = assemble(subdivision, fidelity, supported)
    rhs = system.mass[:, None] * points.double()
    (found,) = solutions(system.rows, system.cols, system.values, rhs, what="the refinement")
    return found


def _normals(
    blend: Blend, vertices: Float[Tensor, "vertex 3"], subdivision: Subdivision
) -> Float[Tensor, "vertex 3"]:
    """Take photometric normals where there are any, else those of the surface itself."""
    own = normalize(vertex_normals(vertices, subdivision.faces), dim=-1)
    photometric = blend.seen & (blend.normals_world.detach().norm(dim=-1) > 0.5)
    return torch.where(photometric[:, None], blend.normals_world, own)
