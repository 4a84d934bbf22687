"""Points spread evenly over a surface."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.errors import InputError
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.records import Mesh, Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SurfaceSamples(Record):
    """Points on a surface, each standing for the same fraction of it.

    Attributes:
        points: World, float64.
        normals: Of the faces they lie in, unit; ``None`` for a point cloud.
        corners: Vertices that each lies between; the one that it is of a point cloud.
        fractions: Of these; they add up to 1.
    """

    points: Float[Tensor, "sample 3"]
    normals: Float[Tensor, "sample 3"] | None
    corners: Int[Tensor, "sample corner"]
    fractions: Float[Tensor, "sample corner"]

    def interpolate(self, per_vertex: Float[Tensor, " vertex"]) -> Float[Tensor, " sample"]:
        """Blend what is known at the vertices of the surface."""
        values = per_vertex.detach().to(self.fractions)[self.corners]
        return (self.fractions * values).sum(dim=1)


def sample_surface(mesh: Mesh, count: int, generator: torch.Generator) -> SurfaceSamples:
    """Draw points uniformly by area; of a point cloud, points without repetition.

    The draw is stratified: the faces' areas laid end to end are cut in ``count`` equal
    pieces, and one point is drawn in each, which makes averages less noisy than independent
    draws do and favours no face.

    Args:
        mesh: A cloud gives its points, all of them if they are no more than ``count``.
        generator: On the CPU.

    Raises:
        InputError: The surface has no extent: no vertices, or faces without any area.
    """
    vertices = mesh.vertices_world.detach().cpu().double()
    faces = mesh.faces.cpu()
    if len(vertices) == 0:
        raise InputError("the surface has no vertices; needed: a mesh or a point cloud.")
    if len(faces) == 0:
        chosen = torch.randperm(len(vertices), generator=generator)[:count]
        corners = chosen[:, None]
        return SurfaceSamples(
            points=vertices[chosen],
            normals=None,
            corners=corners,
            fractions=torch.ones_like(corners, dtype=torch.float64),
        )
    normals = face_normals(vertices, faces)
    ends = normals.norm(dim=1).cumsum(dim=0)
    if not float(ends[-1]) > 0:
        raise InputError(
            f"all {len(faces)} faces of the surface are degenerate; needed: triangles with area."
        )
    face = _drawn(ends, count, generator)
    # Folding the unit square along its diagonal keeps the density of the triangle even.
    u, v = torch.rand(2, count, generator=generator, dtype=torch.float64)
    fold = u + v > 1
    u, v = torch.where(fold, 1 - u, u), torch.where(fold, 1 - v, v)
    a, b, c = vertices[faces[face]].unbind(dim=1)
    points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    return SurfaceSamples(
        points=points,
        normals=normalize(normals[face], dim=1),
        corners=faces[face],
        fractions=torch.stack([1 - u - v, u, v], dim=1),
    )


def _drawn(
    ends: Float[Tensor, " face"], count: int, generator: torch.Generator
) -> Int[Tensor, " sample"]:
    jitter = torch.rand(count, generator=generator, dtype=torch.float64)
    positions = (torch.arange(count) + jitter) / count * ends[-1]
    return torch.searchsorted(ends, positions, right=True).clamp_max(len(ends) - 1)
