"""The light field of all views, from what the coarse mesh knows of the shape."""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.geometry.frames import invert_rigid, transform
from pimper_torch.photometry.light_field import LightField
from pimper_torch.photometry.lights import fit_light_field
from pimper_torch.records import PatchViews

# Light is fitted to this many samples at most; more would only repeat them.
LIGHT_SAMPLES = 10_000


def light_of_mesh(
    seen: PatchViews,
    coarse: list[Float[Tensor, "_ _ _ 3"]],
    min_views: int,
    model: Literal["auto", "soft", "lamp"],
) -> LightField:
    """Fit the light field to samples spread evenly over the facets themselves.

    Args:
        seen: All views on all templates.
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
