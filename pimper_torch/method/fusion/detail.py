"""The distance between a facet's vertices: larger where its patch shows no detail between them.

A grid of twice the spacing loses, at the samples that it leaves out, their difference from the mean
of their neighbours. Where that is small compared with the errors of the patch's values, the facet
does without them. Spacings are powers of two.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.ground.shapes import PatchMask, PatchRaster, PerFacet
from pimper_torch.records import Heights, Photometry, SweptPatches, Templates

# Root mean square of albedo that a coarser grid may lose, relative: 4 of 255 sRGB levels of a
# bright surface, half of the change that simplification may make.
_MAX_ALBEDO = 0.05

# The same of the height that templates carry, in finest spacings: twice the distance that
# simplification may move a vertex.
_MAX_HEIGHT = 0.1


@torch.no_grad()
def spacing_of(swept: SweptPatches, samples_per_vertex: float, max_lost: float) -> PerFacet:
    """Return each facet's distance between neighbouring vertices, scene units; a constant.

    Args:
        samples_per_vertex: Template samples between neighbouring vertices, where they lie closest.
        max_lost: Part of the mean variance of the normals, or of the swept heights, that a facet's
            grid may lose; 0 spaces all vertices alike.
    """
    buckets = zip(swept.patches.buckets, swept.photometric.buckets, swept.buckets, strict=True)
    found = swept.patches.buckets[0].spacing.new_empty(len(swept))
    for templates, photometry, heights in buckets:
        apart = _apart(templates, photometry, heights, max_lost) if max_lost > 0 else 1.0
        found[templates.facet] = samples_per_vertex * apart * templates.spacing
    return found


def _apart(
    templates: Templates, photometry: Photometry, heights: Heights, max_lost: float
) -> Float[Tensor, " patch"]:
    """Return the distance between the vertices of each facet, in finest spacings."""
    own = (templates.barycentric >= 0).all(dim=-1)
    shown, albedo = photometry.observed, photometry.albedo
    bright = _MAX_ALBEDO * _mean(albedo.mean(dim=-1), own & shown)
    flat = (_MAX_HEIGHT * templates.spacing).square()
    limits = [
        (albedo, shown, albedo.shape[-1] * bright.square()),
        (templates.depth[..., None], templates.inside, flat),
    ]
    normals, offset = photometry.normals_patch, heights.offset[..., None]
    for values, information in (normals, photometry.information), (offset, heights.information):
        known = information > 0
        variance = _mean(1 / torch.where(known, information, 1), own & known)
        limits.append((values, known, max_lost * variance))
    apart = torch.ones_like(bright)
    smooth = apart > 0
    # Eight pieces a side stay: a small facet of a cap, curved as a whole, was too stiff with four.
    enough = own.sum(dim=(1, 2)) / (math.sqrt(3) / 4 * 16**2)
    for step in (1, 2):  # a choice: a sixteenth of the vertices is few
        for values, known, limit in limits:
            smooth &= _lost(values, known, own, step) <= limit
        smooth &= enough >= step**2
        apart = torch.where(smooth, 2 * step, apart)
    return apart


def _mean(values: PatchRaster, where: PatchMask) -> Float[Tensor, " patch"]:
    """Average over samples; 0 where there are none."""
    return torch.where(where, values, 0).sum(dim=(1, 2)) / where.sum(dim=(1, 2)).clamp_min(1)


def _lost(
    values: Float[Tensor, "patch height width channel"], known: PatchMask, own: PatchMask, step: int
) -> Float[Tensor, " patch"]:
    """Return the mean square that samples differ by from the mean of those a step before and after.

    Both ways over the raster; 0 where no sample has such neighbours.
    """
    total, count = values.new_zeros(2, len(values))
    for dim in (1, 2):
        length = values.shape[dim] - 2 * step
        if length <= 0:
            continue
        before, at, after = (values.narrow(dim, start * step, length) for start in range(3))
        some = own.narrow(dim, step, length)
        for start in range(3):
            some = some & known.narrow(dim, start * step, length)
        square = ((before + after) / 2 - at).square().sum(dim=-1)
        total += torch.where(some, square, 0).sum(dim=(1, 2))
        count += some.sum(dim=(1, 2))
    return total / count.clamp_min(1)
