"""The vertex spacing of each facet: larger if its patch has no finer detail.

A grid of twice the spacing loses, at the samples that it skips, their difference from the mean of
their neighbours. If this is small compared with the errors of the patch's values, the facet gets
that grid. Spacings are powers of two.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.records import Heights, Photometry, SweptPatches, Templates
from pimper_torch.records.shapes import PatchMask, PatchRaster, PerFacet

# Relative root mean square of albedo that a coarser grid may lose: 4 of 255 sRGB levels of a
# bright surface, half of the change allowed in simplification.
_MAX_ALBEDO = 0.05

# Root mean square of the templates' height that a coarser grid may lose, in finest spacings: twice
# the distance that simplification may move a vertex.
_MAX_HEIGHT = 0.1


@torch.no_grad()
def spacing_of(swept: SweptPatches, samples_per_vertex: float, max_lost: float) -> PerFacet:
    """Return each facet's distance between neighbouring vertices, scene units. Not differentiable.

    Args:
        samples_per_vertex: Template samples between neighbouring vertices at the finest spacing.
        max_lost: Fraction of the mean variance of the normals, or of the swept heights, that a
            facet's grid may lose; 0 gives all facets the finest spacing.
    """
    buckets = zip(swept.patches.buckets, swept.photometric.buckets, swept.buckets, strict=True)
    spacing = swept.patches.buckets[0].spacing.new_empty(len(swept))
    for templates, photometry, heights in buckets:
        factor = _apart(templates, photometry, heights, max_lost) if max_lost > 0 else 1.0
        spacing[templates.facet] = samples_per_vertex * factor * templates.spacing
    return spacing


def _apart(
    templates: Templates, photometry: Photometry, heights: Heights, max_lost: float
) -> Float[Tensor, " patch"]:
    """Return the vertex spacing of each facet, in finest spacings."""
    on_facet = (templates.barycentric >= 0).all(dim=-1)
    observed, albedo = photometry.observed, photometry.albedo
    bright = _MAX_ALBEDO * _mean(albedo.mean(dim=-1), on_facet & observed)
    flat = (_MAX_HEIGHT * templates.spacing).square()
    limits = [
        (albedo, observed, albedo.shape[-1] * bright.square()),
        (templates.depth[..., None], templates.inside, flat),
    ]
    normals, offset = photometry.normals_patch, heights.offset[..., None]
    for values, information in (normals, photometry.information), (offset, heights.information):
        known = information > 0
        variance = _mean(1 / torch.where(known, information, 1), on_facet & known)
        limits.append((values, known, max_lost * variance))
    factor = torch.ones_like(bright)
    smooth = factor > 0
    # At least eight pieces a side: a small curved facet of a cap was too stiff with four.
    enough = on_facet.sum(dim=(1, 2)) / (math.sqrt(3) / 4 * 16**2)
    for step in (1, 2):  # a choice: at least a sixteenth of the vertices
        for values, known, limit in limits:
            smooth &= _lost(values, known, on_facet, step) <= limit
        smooth &= enough >= step**2
        factor = torch.where(smooth, 2 * step, factor)
    return factor


def _mean(values: PatchRaster, where: PatchMask) -> Float[Tensor, " patch"]:
    """Return the mean over samples; 0 if the mask is empty."""
    return torch.where(where, values, 0).sum(dim=(1, 2)) / where.sum(dim=(1, 2)).clamp_min(1)


def _lost(
    values: Float[Tensor, "patch height width channel"], known: PatchMask, own: PatchMask, step: int
) -> Float[Tensor, " patch"]:
    """Return the mean squared difference of samples from the mean of neighbours at a step.

    Neighbours are along rows and columns; 0 if no sample has such neighbours.
    """
    total, count = values.new_zeros(2, len(values))
    for dim in (1, 2):
        length = values.shape[dim] - 2 * step
        if length <= 0:
            continue
        before, centre, after = (values.narrow(dim, start * step, length) for start in range(3))
        mask = own.narrow(dim, step, length)
        for start in range(3):
            mask = mask & known.narrow(dim, start * step, length)
        square = ((before + after) / 2 - centre).square().sum(dim=-1)
        total += torch.where(mask, square, 0).sum(dim=(1, 2))
        count += mask.sum(dim=(1, 2))
    return total / count.clamp_min(1)
