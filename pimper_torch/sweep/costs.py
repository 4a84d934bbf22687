"""Costs of a bucket's samples at all heights, by the compiled sweep."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.geometry.rigid import invert_rigid, transform
from pimper_torch.kernels.arrays import as_array
from pimper_torch.patches.sources import Sources
from pimper_torch.records import Cameras, Observations, Photometry, Templates


def balanced_lights(
    photometry: Photometry,
) -> tuple[Float[Tensor, "patch view 4"], Float[Tensor, "patch view"]]:
    """Return lights over the exposure of their views, and the factors of radiance beside them."""
    lights = photometry.lights_patch
    gains = torch.ones_like(lights[..., 0])
    if photometry.exposure is not None:
        gains = 1 / photometry.exposure
    return lights * gains[..., None], gains


def compiled_costs(
    templates: Templates,
    registered: Observations,
    photometry: Photometry,
    transferred: Float[Tensor, "patch height width 3"],
    cameras: Cameras,
    sources: Sources,
    rows: Int[Tensor, " view"],
    poses: Int[Tensor, " view"] | None,
    *,
    ladder: Float[Tensor, " hypothesis"],
    scale: Float[Tensor, " patch"],
    num_views: int,
    min_views: int,
    min_facing: float,
) -> tuple[Float[Tensor, "patch hypothesis height width"], Float[Tensor, "patch height width"]]:
    """Return the robust cost of every height, and 1 where a sample is swept, else 0.

    Args:
        registered: Which views have which samples.
        rows: Where each camera's photograph is among the sources.
        poses: Number of each view's pose, where some have several.
        transferred: Normals that samples are swept along.
        ladder: Heights that are tried, in samples.
        scale: Of the robust cost, in units of radiance.
        num_views: Largest number of views that a sample is compared in.
        min_views: Least number of them for a sample that is swept.
        min_facing: Cosine of the angle from which on footprints shrink no more.
    """
    from pimper_torch.kernels import sweep_costs

    patch_from_world = templates.patch_from_world.double()
    exact = cameras.to(torch.float64)
    image_from_world = exact.intrinsics @ exact.cam_from_world[:, :3]
    image_from_patch = image_from_world @ invert_rigid(patch_from_world)[:, None]
    lights, gains = balanced_lights(photometry)
    shape = templates.depth.shape
    cost = torch.zeros(shape[0], len(ladder), *shape[1:])
    swept = torch.zeros(shape)
    sweep_costs.costs(
        *sources.gray.arrays,
        as_array(sources.gray.table),
        as_array(rows),
        as_array(image_from_patch.flatten(0, 1)),
        as_array(transform(patch_from_world, exact.centers_world).flatten(0, 1)),
        as_array((exact.intrinsics[:, 0, 0] * exact.intrinsics[:, 1, 1]).sqrt()),
        as_array(templates.origin, torch.float64),
        as_array(templates.spacing, torch.float64),
        as_array(templates.depth, torch.float32),
        as_array(transferred, torch.float32),
        as_array(photometry.normals_patch, torch.float32),
        as_array(lights, torch.float32),
        as_array(gains, torch.float32),
        as_array(registered.valid),
        as_array(photometry.observed & templates.inside),
        as_array(scale, torch.float32),
        as_array(ladder, torch.float64),
        as_array(torch.zeros(0, dtype=torch.long) if poses is None else poses),
        num_views,
        min_views,
        min_facing,
        as_array(cost),
        as_array(swept),
    )
    return cost.to(templates.depth), swept.to(templates.depth)
