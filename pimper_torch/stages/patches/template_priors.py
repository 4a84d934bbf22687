"""Priors on templates: maps of several views, merged per sample."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.pyramids import PriorMaps
from pimper_torch.geometry.rigid import invert_rigid, rotate, transform
from pimper_torch.records import Cameras, LightPrior, Observations, PatchPriors, Templates
from pimper_torch.records.shapes import Scalars


def merged(
    prior_samples: Sequence[tuple[PriorMaps, Observations]],
    hidden: Bool[Tensor, "patch view height width"],
    cameras: Cameras,
    templates: Templates,
    lights: LightPrior | None = None,
) -> PatchPriors:
    """Return the priors of all samples, averaged over views with inverse variances, which add up.

    If values scatter more than their variances indicate, over views or from pixel to pixel, the
    information is that of their scatter. A common error raises the noise factor in the fusion.

    Args:
        prior_samples: Maps, and the samples looked up in them.
        hidden: True where a surface occludes a sample in a view.

    Differentiable in the maps and lights.
    """
    shape = templates.depth.shape
    normals = templates.depth.new_zeros(*shape, 5)
    offsets = templates.depth.new_zeros(*shape, 4)
    albedo = templates.depth.new_zeros(*shape, 2)
    inlier: Float[Tensor, "patch view height width"] | None = None
    for maps, samples in prior_samples:
        seen = samples.valid & ~hidden[:, maps.view]
        values = torch.where(seen[:, :, None], samples.radiance, 0)
        viewers = cameras.take(maps.view)
        if maps.kind == "normals":
            normals = normals + _in_patches(values, seen, viewers, templates, maps.in_world)
        elif maps.kind == "depth":
            offsets = offsets + _offsets(values, seen, viewers, templates)
        elif maps.kind == "albedo":
            albedo = albedo + values.sum(dim=1).movedim(1, -1)
        else:
            before = torch.ones_like(hidden, dtype=values.dtype) if inlier is None else inlier
            probability = torch.where(seen, values[:, :, 0], 1)
            inlier = before.index_copy(1, maps.view, before[:, maps.view] * probability)
    vector, (information, count) = normals[..., :3], normals[..., 3:].unbind(dim=-1)
    length = vector.norm(dim=-1)
    # The mean square of small angles to the mean is 2 (1 - length of the mean vector).
    scatter = 2 * (information - length).clamp_min(0)
    total, square, precision, num_views = offsets.unbind(dim=-1)
    offset = total / torch.where(precision > 0, precision, 1)
    determined = albedo[..., 1] > 0
    divisor = torch.where(determined, albedo[..., 1], 1)
    return PatchPriors(
        normals_patch=normalize(vector, dim=-1),
        normal_information=_scattered(information, scatter, count),
        offset=offset,
        offset_information=_scattered(precision, square - offset * total, num_views),
        albedo=albedo[..., 0] / divisor,
        albedo_variance=torch.where(determined, 1 / divisor, torch.inf),
        inlier=inlier,
        lights_patch=None if lights is None else _rotated(lights, cameras, templates),
        light_variance=None if lights is None else lights.variance.expand(shape[0], -1),
    )


def _rotated(
    prior: LightPrior, cameras: Cameras, templates: Templates
) -> Float[Tensor, "patch view 4"]:
    """Return the prior lights in the frames of patches."""
    rotation = templates.patch_from_world[:, None].to(prior.lights)
    if prior.frame == "camera":
        rotation = rotation @ invert_rigid(cameras.cam_from_world).to(rotation)
    ambient = prior.lights[:, :1].expand(len(rotation), -1, 1)
    vectors = (rotation[..., :3, :3] @ prior.lights[:, 1:, None])[..., 0]
    return torch.cat([ambient, vectors], dim=-1)


def _scattered(information: Scalars, scatter: Scalars, count: Scalars) -> Scalars:
    """Return the information divided by the squared Birge ratio where that is above 1.

    Args:
        information: Sum over views.
        scatter: Sum of squared differences to the mean, times their information.

    Source: Birge, The calculation of errors by the method of least squares, 1932.
    """
    return information / (scatter / (count - 1).clamp_min(1)).clamp_min(1)


def _in_patches(
    values: Float[Tensor, "patch map 4 height width"],
    seen: Bool[Tensor, "patch map height width"],
    cameras: Cameras,
    templates: Templates,
    in_world: bool,
) -> Float[Tensor, "patch height width 5"]:
    """Return sums over views: normals (patch frame) times information, information, and count."""
    rotation = templates.patch_from_world[:, None, :3, :3].to(values)
    if not in_world:
        rotation = rotation @ cameras.cam_from_world[:, :3, :3].mT.to(values)
    rotation = rotation.expand(*values.shape[:2], 3, 3)
    vectors = torch.einsum("pmij,pmjhw->phwi", rotation, values[:, :, :3])
    rest = torch.stack([values[:, :, 3].sum(dim=1), seen.sum(dim=1)], dim=-1)
    return torch.cat([vectors, rest], dim=-1)


def _offsets(
    values: Float[Tensor, "patch map 2 height width"],
    seen: Bool[Tensor, "patch map height width"],
    cameras: Cameras,
    templates: Templates,
) -> Float[Tensor, "patch height width 4"]:
    """Return sums over views: offsets and their squares times information, that, and count.

    A point deeper in a view by a fraction of its depth is farther along its ray by the same
    fraction. Its offset from the template is the component of this along the normal.
    """
    world_from_patch = invert_rigid(templates.patch_from_world)
    points = transform(world_from_patch, templates.points_patch.flatten(1, 2))
    outward = templates.normals_patch
    if outward is None:
        outward = templates.depth.new_tensor([0, 0, -1]).expand(*templates.depth.shape, 3)
    outward = rotate(world_from_patch, outward.flatten(1, 2))[:, None]
    ray = points[:, None] - cameras.centers_world[:, None]
    depth = (ray * cameras.cam_from_world[:, None, 2, :3]).sum(dim=-1)
    rate = ((ray * outward).sum(dim=-1) / depth).reshape(values[:, :, 0].shape)
    weighted, precision = values.unbind(dim=2)
    usable = seen & (precision > 0) & (rate != 0)
    # The offset is (d - z) rate, with a variance of rate^2 over the precision.
    slope = torch.where(usable, rate, 1)
    information = torch.where(usable, precision / slope.square(), 0)
    deeper = weighted / torch.where(usable, precision, 1) - depth.reshape(rate.shape)
    offset = torch.where(usable, deeper * slope, 0)
    total = information * offset
    return torch.stack([total, total * offset, information, usable], dim=-1).sum(dim=1)
