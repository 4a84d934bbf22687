"""The light field of all views, from what the coarse mesh knows of the shape."""

import math
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.geometry.frames import invert_rigid, transform
from pimper_torch.photometry.light_field import LightField
from pimper_torch.photometry.lights import fit_light_field
from pimper_torch.records import PatchSet, PatchViews, Templates

# Light is fitted to this many samples at most; more would only repeat them.
LIGHT_SAMPLES = 10_000

# Thinned templates keep so many times as many samples on their facets: what no view shows is among
# them.
_SPARE = 2


def thinned(patches: PatchSet) -> PatchSet:
    """Keep every so many samples of each template, enough to fit the light to.

    Light can so be fitted before all views are resampled on all templates. All patches keep some:
    lights fitted to as many samples of every seventh patch alone were 1.3 degrees off in the
    median view of the skull, those fitted to samples of all patches 0.2.

    Returns:
        Templates with fewer rows and columns, the samples where they were.
    """
    own = sum(int((each.barycentric >= 0).all(dim=-1).sum()) for each in patches.buckets)
    step = max(1, math.isqrt(own // (_SPARE * LIGHT_SAMPLES)))
    return patches.replace(buckets=tuple(_every(each, step) for each in patches.buckets))


def _every(templates: Templates, step: int) -> Templates:
    height, width = templates.depth.shape[1:]
    step = max(1, min(step, height // 2, width // 2))
    first = (step - 1) // 2
    raster = (slice(None), slice(first, None, step), slice(first, None, step))
    normals = templates.normals_patch
    return templates.replace(
        origin=templates.origin + first * templates.spacing[:, None],
        spacing=step * templates.spacing,
        depth=templates.depth[raster],
        barycentric=templates.barycentric[raster],
        inside=templates.inside[raster],
        normals_patch=None if normals is None else normals[raster],
    )


def light_of_mesh(
    seen: PatchViews,
    coarse: list[Float[Tensor, "_ _ _ 3"]],
    min_views: int,
    model: Literal["auto", "soft", "lamp"],
) -> LightField:
    """Fit the light field to samples spread evenly over the facets themselves.

    Args:
        seen: All views on all templates, :func:`thinned` or not.
        coarse: Normals of what the templates carry, bucket by bucket, patch frame.
        min_views: Views a sample must be valid in.
        model: See :func:`~pimper_torch.photometry.lights.fit_light_field`.

    Differentiable in radiance, normals and templates; which samples are taken is constant.
    """
    chosen = [
        (templates.barycentric >= 0).all(dim=-1) & (registered.valid.sum(dim=1) >= min_views)
        for templates, registered in zip(seen.patches.buckets, seen.buckets, strict=True)
    ]
    stride = max(1, -(-sum(int(each.sum()) for each in chosen) // LIGHT_SAMPLES))
    radiance, visible, normals, points = [], [], [], []
    for templates, registered, blend, these in zip(
        seen.patches.buckets, seen.buckets, coarse, chosen, strict=True
    ):
        patch, row, column = (part[::stride] for part in these.nonzero(as_tuple=True))
        gray = registered.radiance[patch, :, :, row, column].mean(dim=2)
        finite = gray.isfinite()
        radiance.append(torch.where(finite, gray, 0))
        visible.append(registered.valid[patch, :, row, column] & finite)
        to_world = templates.patch_from_world[patch, :3, :3].to(blend)
        normals.append((blend[patch, row, column, None] @ to_world)[:, 0])
        places = templates.points_patch[patch, row, column, None]
        points.append(transform(invert_rigid(templates.patch_from_world[patch]), places)[:, 0])
    return fit_light_field(
        torch.cat(radiance),
        torch.cat(visible),
        torch.cat(normals),
        torch.cat(points),
        model=model,
    )
