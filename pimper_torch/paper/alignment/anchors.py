"""Where the surface is known to pass: facets' vertices, and points of the cloud on facets."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.geometry.frames import transform
from pimper_torch.geometry.height_fields import sample_raster
from pimper_torch.records import CoarseMesh, PatchSet, Record
from pimper_torch.records.patches import Depths, Templates


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Anchors(Record):
    """Points that height fields are to pass through, any number a facet.

    Attributes:
        samples: ``(x, y, z)`` of the height field, before any transform, over the point; patch
            frame.
        heights: z of the point itself.
        variance: Of the point's place along the facet's normal, scene units squared.
        known: Whether there is height field over the point.
    """

    facet: Int[Tensor, " anchor"]
    samples: Float[Tensor, "anchor 3"]
    heights: Float[Tensor, " anchor"]
    variance: Float[Tensor, " anchor"]
    known: Bool[Tensor, " anchor"]


def vertex_anchors(patches: PatchSet, buckets: tuple[Depths, ...]) -> Anchors:
    """Anchor every height field at its facet's three vertices; in the order of the facets."""
    coarse = patches.coarse
    faces = coarse.mesh.faces
    facet = torch.arange(len(faces), device=faces.device).repeat_interleave(3)
    covariance = coarse.covariance_world
    return _anchors(
        patches,
        buckets,
        facet,
        coarse.mesh.vertices_world[faces.flatten()],
        None if covariance is None else covariance[faces.flatten()],
    )


def point_anchors(patches: PatchSet, buckets: tuple[Depths, ...]) -> Anchors:
    """Anchor height fields at the points of the cloud on their facets; none for a mesh without."""
    coarse: CoarseMesh = patches.coarse
    points = coarse.points
    if points is None:
        nobody = coarse.mesh.faces.new_zeros(0)
        return _anchors(patches, buckets, nobody, coarse.mesh.vertices_world[:0], None)
    return _anchors(patches, buckets, points.facet, points.points_world, points.covariance_world)


def anchor_certainty(
    variance: Float[Tensor, " anchor"], noise: Float[Tensor, ""]
) -> Float[Tensor, " anchor"]:
    r"""Weigh anchors by one over their variance, next to one that is known exactly.

    A height field misses an anchor by its own error, of which the disagreement at the seams is
    the measure, and by the point's: :math:`s^2 / (s^2 + \sigma^2)`. A point known far
    better than height fields agree counts fully, and not more the better it is known.

    Args:
        variance: :math:`\sigma^2` of each point, along the height field's z.
        noise: s, of the height fields, in the same units.
    """
    return noise.square() / (noise.square() + variance)


def _anchors(
    patches: PatchSet,
    buckets: tuple[Depths, ...],
    facet: Int[Tensor, " anchor"],
    points_world: Float[Tensor, "anchor 3"],
    covariance_world: Float[Tensor, "anchor 3 3"] | None,
) -> Anchors:
    samples = points_world.new_zeros(len(facet), 3).double()
    heights, variance = torch.zeros_like(samples[:, 0]), torch.zeros_like(samples[:, 0])
    known = torch.zeros_like(facet, dtype=torch.bool)
    order = facet.argsort(stable=True)
    in_order = facet[order]
    for templates, depths in zip(patches.buckets, buckets, strict=True):
        place, patch, slot = _members(in_order, templates)
        which = order[place]
        if len(which) == 0:
            continue
        table = which.new_zeros(len(templates.facet), int(slot.max()) + 1)
        table[patch, slot] = which
        frames = templates.patch_from_world.double()
        places = transform(frames, points_world[table].double())
        grid = templates.origin.double(), templates.spacing.double()
        height = sample_raster(
            depths.depth[:, None], places[..., :2], *grid, valid=depths.valid
        ).squeeze(1)
        support = sample_raster(
            depths.valid[:, None].to(depths.depth), places[..., :2], *grid
        ).squeeze(1)
        found = torch.cat([places[..., :2], height[..., None]], dim=-1)[patch, slot]
        samples = samples.index_copy(0, which, found)
        heights[which] = places[patch, slot, 2].detach()
        known[which] = support[patch, slot] > 0.5
        if covariance_world is not None:
            along = frames[patch, 2, :3, None]
            covariance = covariance_world[which].double()
            variance[which] = (along.mT @ covariance @ along).flatten().clamp_min(0)
    return Anchors(facet=facet, samples=samples, heights=heights, variance=variance, known=known)


def _members(
    in_order: Int[Tensor, " anchor"], templates: Templates
) -> tuple[Int[Tensor, " member"], Int[Tensor, " member"], Int[Tensor, " member"]]:
    """List the anchors of a bucket, the patch of each, and a number among that patch's own.

    Args:
        in_order: Facets of all anchors, ascending.
    """
    start = torch.searchsorted(in_order, templates.facet)
    counts = torch.searchsorted(in_order, templates.facet, right=True) - start
    patch = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
    first = counts.cumsum(dim=0) - counts
    slot = torch.arange(len(patch), device=patch.device) - first[patch]
    return start[patch] + slot, patch, slot
