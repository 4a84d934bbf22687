"""Priors on templates: guessed maps of several views, merged sample by sample."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.ground.geometry.pyramids import PriorMaps
from pimper_torch.ground.geometry.rigid import invert_rigid, rotate, transform
from pimper_torch.ground.shapes import Scalars
from pimper_torch.records import Cameras, LightPrior, Observations, PatchPriors, Templates


def merged(
    guesses: Sequence[tuple[PriorMaps, Observations]],
    hidden: Bool[Tensor, "patch view height width"],
    cameras: Cameras,
    templates: Templates,
    lights: LightPrior | None = None,
) -> PatchPriors:
    """Average guesses of one sample by their inverse variance, which adds up.

    Where they scatter more than they claim, over views or from pixel to pixel, the information is
    what their scatter shows. An error that all of them have in common does not scatter: the fusion
    finds more noise than is claimed.

    Args:
        guesses: Maps, and what was looked up in them.
        hidden: Where a surface occludes a sample in a view.

    Differentiable in the maps and lights.
    """
    shape = templates.depth.shape
    normals = templates.depth.new_zeros(*shape, 5)
    offsets = templates.depth.new_zeros(*shape, 4)
    albedo = templates.depth.new_zeros(*shape, 2)
    inlier: Float[Tensor, "patch view height width"] | None = None
    for maps, guess in guesses:
        seen = guess.valid & ~hidden[:, maps.view]
        values = torch.where(seen[:, :, None], guess.radiance, 0)
        own = cameras.take(maps.view)
        if maps.kind == "normals":
            normals = normals + _in_patches(values, seen, own, templates, maps.in_world)
        elif maps.kind == "depth":
            offsets = offsets + _offsets(values, seen, own, templates)
        elif maps.kind == "albedo":
            albedo = albedo + values.sum(dim=1).movedim(1, -1)
        else:
            ones = torch.ones_like(hidden, dtype=values.dtype) if inlier is None else inlier
            own_inlier = torch.where(seen, values[:, :, 0], 1)
            inlier = ones.index_copy(1, maps.view, ones[:, maps.view] * own_inlier)
    vector, (information, count) = normals[..., :3], normals[..., 3:].unbind(dim=-1)
    length = vector.norm(dim=-1)
    # Of vectors that scatter by small angles, 1 less the mean's length is half their mean square.
    scatter = 2 * (information - length).clamp_min(0)
    total, mean_square, certain, seen_in = offsets.unbind(dim=-1)
    offset = total / torch.where(certain > 0, certain, 1)
    precise = albedo[..., 1] > 0
    one = torch.where(precise, albedo[..., 1], 1)
    rotated: Float[Tensor, "patch view 4"] | None = None
    if lights is not None:
        rotation = templates.patch_from_world[:, None].to(lights.lights)
        if lights.frame == "camera":
            rotation = rotation @ invert_rigid(cameras.cam_from_world).to(rotation)
        ambient = lights.lights[:, :1].expand(*shape[:1], -1, 1)
        vectors = (rotation[..., :3, :3] @ lights.lights[:, 1:, None])[..., 0]
        rotated = torch.cat([ambient, vectors], dim=-1)
    return PatchPriors(
        normals_patch=normalize(vector, dim=-1),
        normal_information=_scattered(information, scatter, count),
        offset=offset,
        offset_information=_scattered(certain, mean_square - offset * total, seen_in),
        albedo=albedo[..., 0] / one,
        albedo_variance=torch.where(precise, 1 / one, torch.inf),
        inlier=inlier,
        lights_patch=rotated,
        light_variance=None if lights is None else lights.variance.expand(shape[0], -1),
    )


def _scattered(information: Scalars, scatter: Scalars, count: Scalars) -> Scalars:
    """Lower information by the Birge ratio, where it is above 1.

    Args:
        information: Sum of those of single guesses.
        scatter: Sum of their squared differences from the mean, times their information.

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
    """Sum up normals times their information, in the patch frame, the information, and views."""
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
    """Sum up offsets times their information, their squares times it, that, and views.

    A point that lies deeper in a view by a fraction of its depth lies as much further along its
    ray, and off the template by the part of that along its normal.
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
    # Of the offset: (d - z) rate, with a variance of rate^2 over the precision.
    steep = torch.where(usable, rate, 1)
    certain = torch.where(usable, precision / steep.square(), 0)
    behind = weighted / torch.where(usable, precision, 1) - depth.reshape(rate.shape)
    offset = torch.where(usable, behind * steep, 0)
    total = certain * offset
    return torch.stack([total, total * offset, certain, usable], dim=-1).sum(dim=1)
