"""Refinement: relief of all patches in, one joined surface out."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.config import require
from pimper_torch.fusion.continuation import about_mean
from pimper_torch.fusion.union import Union, ray_directions, unite, vertex_spacing
from pimper_torch.geometry.lattice import Lattice, subdivide
from pimper_torch.geometry.surfaces import face_edges, vertex_normals
from pimper_torch.linalg.systems import solutions
from pimper_torch.paper.refinement.energy import assemble, facet_trends, plane_pull
from pimper_torch.records import Convergence, DepthPatches, StopCause, Surface
from pimper_torch.stage import Stage


@dataclass(frozen=True, slots=True, kw_only=True)
class RefineConfig:
    """How finely the patches are joined, and how much seams are smoothed.

    Attributes:
            Time and memory fall with its square.
        smoothing_radius_samples: ``r``, in vertices of the surface: lambda is
            ``1 / (r * spacing)^2``, the inverse square of a length. Where G is constant, a
            wave of length ``w`` keeps ``1 / (1 + (2 pi R / w)^2)`` of its height, with
            ``R = r sqrt(G / (1 - G))`` vertices: half of it at ``w = 2 pi R``. R is ``r`` on
            the middle of an edge, 1.55 ``r`` at a vertex of the coarse mesh, nothing in the
            middle of a facet. Twice the radius is a quarter of lambda. The notebook
            ``02_refinement`` shows it.
        hold_planes: Cancel what the energy's tension does to flat data, which it would
            shrink at the open rim and shift where G changes. False is the published energy.
        outlier_samples: How far, in samples, a patch may lie from the others before they
            outvote it, where three or more meet; infinite for the plain mean.
    """

    smoothing_radius_samples: float = 1.0
    hold_planes: bool = True
    outlier_samples: float = 4.0

    def __post_init__(self) -> None:
        for name in ("smoothing_radius_samples", "outlier_samples"):
            value = getattr(self, name)
            require(value > 0, name, value, "above 0")


class Refine(Stage):
    r"""Join the patches and smooth their seams, keeping the middle of every facet.

    Minimises :math:`\int \lambda (1-G) |\cup S_\mu - S|^2 + G |\nabla S|^2` over the lattice
    of the coarse mesh, with places S as unknowns: one sparse factorization, three right-hand
    sides. See :mod:`~pimper_torch.paper.refinement.energy` for the discretisation and for what
    ``hold_planes`` adds to the published energy, and :mod:`~pimper_torch.fusion.union` for the
    union. Vertices that no patch supports are
    filled by the smoothness term and have confidence 0.

    Differentiable in depth, photometric normals, albedo and confidence; the coarse mesh and
    the templates are constants.
    """

    def __init__(self, config: RefineConfig | None = None) -> None:
        super().__init__()
        self.config = config or RefineConfig()

    def forward(self, depths: DepthPatches) -> Surface:
        """Refine the union of all patches.

        The convergence's residual is the root mean square distance between the union and
        the surface, in scene units, after one solve.

        Where no patch has valid relief anywhere, as under one light for all views, the
        surface is that of the facets, its seams smoothed, with confidence 0.
        """
        patches = depths.patches
        mesh = patches.coarse.mesh
        spacing = vertex_spacing(patches, 1.0)
        lattice = subdivide(mesh.vertices_world.detach(), mesh.faces, spacing)
        directions = ray_directions(lattice, patches.coarse).detach()
        union = unite(depths, lattice, directions, self.config.outlier_samples)
        if not bool(union.supported.any()):
            union = union.replace(supported=torch.ones_like(union.supported))
        points = lattice.points + union.heights[:, None] * directions
        refined = smooth_seams(lattice, points, union.supported, spacing, self.config)
        vertices = refined.to(points)
        apart = (refined - points.double())[union.supported].detach()
        return Surface(
            vertices_world=vertices,
            faces=lattice.faces,
            facet=lattice.facet,
            barycentric=lattice.barycentric,
            normals_world=_normals(union, vertices, lattice),
            albedo=about_mean(union.albedo, union.seen, face_edges(lattice.faces)[0]),
            confidence=union.confidence,
            convergence=Convergence(
                iterations=torch.ones(1, dtype=torch.long, device=points.device),
                residual=apart.square().sum(dim=-1).mean().sqrt()[None].to(points),
                cause=torch.full((1,), int(StopCause.CONVERGED), device=points.device),
            ),
        )


def smooth_seams(
    lattice: Lattice,
    points: Float[Tensor, "vertex 3"],
    supported: Bool[Tensor, " vertex"],
    spacing: Float[Tensor, " facet"],
    config: RefineConfig,
) -> Float[Tensor, "vertex 3"]:
    """Minimise the energy over the lattice.

    Args:
        lattice: The flat facets, subdivided.
        points: The union: where the patches have each vertex.
        supported: Where they have it anywhere.
        spacing: Of each facet's vertices, scene units; the radius is counted in it.
        config: Radius and whether planes are held.

    Returns:
        The places in float64.

    Differentiable in ``points``; see :class:`Refine`.
    """
    fidelity = (config.smoothing_radius_samples * spacing.double()) ** -2
    system = assemble(lattice, fidelity, supported)
    rhs = system.mass[:, None] * points.double()
    if config.hold_planes:
        trends, fitted = facet_trends(lattice, points, supported, len(spacing))
        rhs = rhs + plane_pull(lattice, trends, fitted)
    (found,) = solutions(system.rows, system.cols, system.values, rhs, what="the refinement")
    return found


def _normals(
    union: Union, vertices: Float[Tensor, "vertex 3"], lattice: Lattice
) -> Float[Tensor, "vertex 3"]:
    """Take photometric normals where there are any, else those of the surface itself."""
    own = normalize(vertex_normals(vertices, lattice.faces), dim=-1)
    photometric = union.seen & (union.normals_world.detach().norm(dim=-1) > 0.5)
    return torch.where(photometric[:, None], union.normals_world, own)
