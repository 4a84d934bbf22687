"""Where the surface is known to pass: at the facets' vertices."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.geometry.frames import transform
from pimper_torch.geometry.height_fields import sample_raster
from pimper_torch.records import PatchSet, Record
from pimper_torch.records.patches import Depths


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Anchors(Record):
    """The vertices of every facet, which its height field is to pass through.

    Attributes:
        samples: ``(x, y, z)`` of the height field, before any transform, over the vertex; patch
            frame.
        variance: Of the vertex's place along the facet's normal, scene units squared.
        known: Whether there is height field over the vertex.
    """

    samples: Float[Tensor, "face 3 3"]
    variance: Float[Tensor, "face 3"]
    known: Bool[Tensor, "face 3"]


def vertex_anchors(patches: PatchSet, buckets: tuple[Depths, ...]) -> Anchors:
    """Anchor every height field at its facet's three vertices."""
    faces, covariance = patches.coarse.mesh.faces, patches.coarse.covariance_world
    vertices = patches.coarse.mesh.vertices_world[faces].double()
    samples = torch.zeros_like(vertices)
    variance = torch.zeros_like(samples[..., 0])
    known = torch.zeros_like(faces, dtype=torch.bool)
    for templates, depths in zip(patches.buckets, buckets, strict=True):
        facet, frames = templates.facet, templates.patch_from_world.double()
        across = transform(frames, vertices[facet])[..., :2]
        grid = templates.origin.double(), templates.spacing.double()
        height = sample_raster(depths.depth[:, None], across, *grid, valid=depths.valid)
        support = sample_raster(depths.valid[:, None].to(depths.depth), across, *grid)
        found = torch.cat([across, height.mT], dim=-1)
        samples = samples.index_copy(0, facet, found)
        known[facet] = support[:, 0] > 0.5
        if covariance is not None:
            along = frames[:, None, 2, :3, None]
            spread = along.mT @ covariance[faces[facet]].double() @ along
            variance[facet] = spread[..., 0, 0].clamp_min(0)
    return Anchors(samples=samples, variance=variance, known=known)


def anchor_certainty(
    variance: Float[Tensor, "*batch"], noise: Float[Tensor, ""]
) -> Float[Tensor, "*batch"]:
    r"""Weigh anchors by one over their variance, next to one that is known exactly.

    A height field misses an anchor by its own error, of which the disagreement at the seams is
    the measure, and by the point's: :math:`s^2 / (s^2 + \sigma^2)`. A point known far
    better than height fields agree counts fully, and not more the better it is known.

    Args:
        variance: :math:`\sigma^2` of each point, along the height field's z.
        noise: s, of the height fields, in the same units.
    """
    return noise.square() / (noise.square() + variance)
