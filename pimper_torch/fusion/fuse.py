"""The stage that makes one surface of slopes, swept heights and the cloud's points."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import normalize

from pimper_torch.config import require
from pimper_torch.fusion.estimate import fuse_evidence
from pimper_torch.fusion.drift import drift
from pimper_torch.fusion.evidence import (
    cloud_points,
    edges_of,
    slopes,
    swept_heights,
)
from pimper_torch.fusion.union import Union, ray_directions, unite
from pimper_torch.geometry.lattice import Lattice, subdivide
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.photometry.certainty import HALF_CONFIDENCE_DEG
from pimper_torch.records import (
    Convergence,
    DepthPatches,
    Depths,
    FacetPoints,
    PatchSet,
    StopCause,
    Surface,
    SweptPatches,
)

@dataclass(frozen=True, slots=True, kw_only=True)
class FuseConfig:
    """How the lattice is laid, and how its evidence is weighed."""

    samples_per_vertex: float = 1.0
    window_samples: float = 1.5
    rounds: int = 3
    bias_rounds: int = 2
    outlier_samples: float = 4.0
    heights: bool = True
    slopes: bool = True
    points: bool = True


class Fuse(nn.Module):
    """Fuse."""

    def __init__(self, config: FuseConfig | None = None) -> None:
        super().__init__()
        self.config = config or FuseConfig()

    def forward(self, swept: SweptPatches) -> Surface:
        config, patches = self.config, swept.patches
        mesh = patches.coarse.mesh
        spacing = vertex_spacing(patches, config.samples_per_vertex)
        lattice = subdivide(mesh.vertices_world.detach(), mesh.faces, spacing)
        directions = ray_directions(lattice, patches.coarse).detach()
        union = unite(carried_reliefs(swept), lattice, directions, config.outlier_samples, swept.buckets)
        carried = union.heights
        places = lattice.points + carried[:, None] * directions
        own = vertex_normals(places.detach(), lattice.faces)
        edges = edges_of(lattice.faces)
        half = math.radians(HALF_CONFIDENCE_DEG)
        variance = half**2 * (1 / union.confidence.clamp(1e-4, 1 - 1e-4) - 1)
        known = union.seen & (union.confidence > 0)
        normals = union.normals_world
        both = known[edges].all(dim=1)
        # Where light says nothing the surface keeps its slopes, as well as these are known.
        angle = (normals[known] * own[known]).sum(dim=-1).clamp(-1, 1).acos()
        doubt = (1.4826 * angle.median()).square() if len(angle) else own.new_tensor(half**2)
        facing = (own * directions).sum(dim=-1)
        ends = edges[~both] if config.slopes else edges
        kept = slopes(ends, lattice.points, directions, own, doubt.expand(len(own)))
        kept = kept.replace(targets=(kept.coefficients * carried[ends]).sum(dim=1), judged=False)
        kinds = [kept]
        if config.heights:
            correlated = 4 * math.pi * (config.window_samples / config.samples_per_vertex) ** 2
            kinds.append(
                swept_heights(carried, union.offsets, union.information, facing, correlated)
            )
        cloud = patches.coarse.points
        if config.points and cloud is not None and len(cloud.points_world):
            reach = 20 * float(spacing.median())
            kinds.append(
                cloud_points(cloud, places.detach(), lattice.faces, carried, directions, reach)
            )
        weakest = 1e-4 / (spacing.median().double() ** 2)
        prior = weakest.expand(len(carried))
        generator = torch.Generator().manual_seed(0)
        self.kinds = kinds
        shape = own
        self.log = []
        factors = None
        fused = None
        if config.slopes:
            for again in range(config.bias_rounds):
                field = drift(lattice, mesh.faces, normals, shape, known)
                length = field.tilt.norm(dim=-1)[field.known]
                bias = (length.square().median() / 1.386) if len(length) else variance.new_tensor(0.0)
                self.log.append(math.degrees(float(bias) ** 0.5))
                shared = bias * field.count[lattice.facet]
                found = slopes(edges[both], lattice.points, directions, normals, variance, shared)
                fused = fuse_evidence([*kinds, found], carried, prior, config.rounds, generator)
                self.log.append([round(f, 3) for f in fused.factors])
                vertices = lattice.points + fused.heights.to(carried)[:, None] * directions
                shape = vertex_normals(vertices, lattice.faces)
            field = drift(lattice, mesh.faces, normals, shape, known)
            normals = normalize(normals + field.at(lattice, mesh.faces), dim=-1)
            found = slopes(edges[both], lattice.points, directions, normals, variance)
            kinds.append(found)
        fused = fuse_evidence(kinds, carried, prior, config.rounds, generator)
        self.factors = fused.factors
        heights = fused.heights.to(carried)
        vertices = lattice.points + heights[:, None] * directions
        shape = vertex_normals(vertices, lattice.faces)
        return Surface(
            vertices_world=vertices,
            faces=lattice.faces,
            facet=lattice.facet,
            barycentric=lattice.barycentric,
            normals_world=shape,
            albedo=union.albedo,
            confidence=union.confidence,
            convergence=Convergence(
                iterations=torch.full((1,), config.rounds),
                residual=(heights - carried).detach().square().mean().sqrt()[None],
                cause=torch.full((1,), int(StopCause.CONVERGED)),
            ),
        )


def carried_reliefs(swept: SweptPatches) -> DepthPatches:
    """Take what the templates carry as their relief."""
    return DepthPatches(
        photometric=swept.photometric,
        buckets=tuple(
            Depths(
                depth=templates.depth,
                valid=templates.inside,
                transform=templates.depth.new_tensor([0, 0, 1, 0]).expand(len(templates.facet), 4),
            )
            for templates in swept.patches.buckets
        ),
    )


def vertex_spacing(patches: PatchSet, samples_per_vertex: float) -> Float[Tensor, " facet"]:
    """Give each facet's wanted distance between neighbouring vertices, scene units."""
    facet = torch.cat([bucket.facet for bucket in patches.buckets])
    spacing = torch.cat([bucket.spacing for bucket in patches.buckets])
    return torch.empty_like(spacing).index_put((facet,), spacing * samples_per_vertex)
