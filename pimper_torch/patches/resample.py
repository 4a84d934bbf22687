"""The compiled registration of a bucket of templates: the matrices J and D."""

import torch
from jaxtyping import Bool, Int
from torch import Tensor
from torch.nn.functional import interpolate

from pimper_torch.geometry.rigid import invert_rigid, transform
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.kernels.arrays import as_array
from pimper_torch.patches.sources import Sources
from pimper_torch.records import Cameras, Observations, Templates


def resampled(
    cameras: Cameras,
    sources: Sources,
    templates: Templates,
    rows: Int[Tensor, " view"],
    min_facing: float,
    dark_level: float,
) -> Observations:
    """Resample views on a bucket of templates, without occlusion.

    Pixels are computed in float64; images are looked up in float32.

    Args:
        rows: Where each camera's photograph is among the sources.
        min_facing: Cosine of the steepest angle between a normal and the way to the camera.
        dark_level: Radiance at or below which a sample is missing.
    """
    from pimper_torch.kernels import resampling

    patch_from_world = templates.patch_from_world.double()
    exact = cameras.to(torch.float64)
    image_from_world = exact.intrinsics @ exact.cam_from_world[:, :3]
    image_from_patch = image_from_world @ invert_rigid(patch_from_world)[:, None]
    outward = templates.normals_patch
    if outward is None:
        outward = templates.depth.new_tensor([0, 0, -1]).expand(*templates.depth.shape, 3)
    shape = len(templates.facet), cameras.num_views
    height, width = templates.depth.shape[1:]
    radiance = torch.empty(*shape, sources.images.finest.shape[1], height, width)
    valid = torch.empty(*shape, height, width, dtype=torch.bool)
    resampling.register(
        *sources.images.arrays,
        *sources.unusable.arrays,
        as_array(sources.images.table),
        as_array(rows),
        as_array(image_from_patch.flatten(0, 1)),
        as_array(transform(patch_from_world, exact.centers_world).flatten(0, 1)),
        as_array(cameras.sizes_px),
        as_array(templates.origin, torch.float64),
        as_array(templates.spacing, torch.float64),
        as_array(templates.depth, torch.float32),
        as_array(outward, torch.float32),
        as_array(templates.inside),
        min_facing,
        dark_level,
        as_array(radiance),
        as_array(valid),
    )
    return Observations(radiance=radiance, valid=valid)


def occluded(
    valid: Bool[Tensor, "patch view height width"],
    cameras: Cameras,
    caster: RayCaster,
    templates: Templates,
    stride: int,
) -> Bool[Tensor, "patch view height width"]:
    """Find samples that a surface occludes; a constant to autograd.

    One ray for every ``stride`` samples either way, from the camera to just before the surface,
    where one of these samples is valid; all of a bucket at once.
    """
    middle = slice(stride // 2, None, stride)
    sparse = templates.points_patch.detach()[:, middle, middle].double()
    if sparse.numel() == 0:
        return torch.zeros_like(valid)
    world_from_patch = invert_rigid(templates.patch_from_world.detach().double())
    points = transform(world_from_patch, sparse.flatten(1, 2)).reshape(sparse.shape)
    rows, columns = (
        _nearest_site(sites, samples).to(valid.device)
        for sites, samples in zip(sparse.shape[1:3], valid.shape[2:], strict=True)
    )
    shape = *valid.shape[:2], len(points[0]), valid.shape[3]
    near = valid.new_zeros(shape).index_add_(2, rows, valid)
    near = near.new_zeros(*near.shape[:3], points.shape[2]).index_add_(3, columns, near)
    patch, view, row, column = near.nonzero(as_tuple=True)
    starts = cameras.centers_world.detach().double()[view]
    directions = points[patch, row, column] - starts
    length = directions.norm(dim=1)
    # An enlarged triangle dips under its neighbours by the overlap's fraction of their slope.
    reach = (length - 4 * stride * templates.spacing.detach()[patch]).clamp_min(0)
    near[patch, view, row, column] = caster.blocked(starts, directions / length[:, None], reach)
    return near[:, :, rows][..., columns]


def _nearest_site(sites: int, samples: int) -> Int[Tensor, " sample"]:
    """Return the site nearest to each of a row of samples."""
    index = torch.arange(sites, dtype=torch.float32)[None, None]
    return interpolate(index, size=samples, mode="nearest-exact")[0, 0].long()
