"""Matching costs of a bucket's samples at all heights, under the fitted light.

A kernel computes them in float32 on the CPU, and its adjoint the gradients; the torch functions
here are its reference.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import normalize

from pimper_torch.geometry.projection import project
from pimper_torch.geometry.pyramids import (
    Sources,
    centers_in_patches,
    image_from_patch,
    kernel_geometry,
    look_up,
)
from pimper_torch.geometry.rigid import invert_rigid, rotate, transform
from pimper_torch.kernels.arrays import as_array, pulled_back
from pimper_torch.kernels.compile import load
from pimper_torch.kernels.switch import compiled_for
from pimper_torch.records import Cameras, Observations, Photometry, Record, Templates

PerView = Float[Tensor, "sample view"]
SeenBy = Bool[Tensor, "sample view"]
PerSample = Float[Tensor, " sample"]
_Array = NDArray[Any]


def inconsistency(
    radiance: Float[Tensor, "sample view hypothesis"],
    shading: PerView,
    seen: SeenBy,
    scale: PerSample,
    iterations: int = 2,
) -> Float[Tensor, "sample hypothesis"]:
    r"""Return the robust cost of every hypothesis.

    .. math:: C = \sum_g \tfrac12 \log(1 + (x_g - \rho s_g)^2 / c^2)

    The albedo is the median over views, refined by ``iterations`` re-weighted means.

    Args:
        radiance: Radiance of the sample in each view under the hypothesis.
        shading: For albedo 1, the same for all hypotheses; positive where seen.
        seen: Views that are compared; common to all hypotheses, so that costs are comparable.
        scale: ``c``, in units of radiance.

    Differentiable in radiance, shading and scale, through the iterations of the albedo.
    """
    s = torch.where(seen, shading, 1)[..., None]
    used, per_scale = seen[..., None].to(radiance), 1 / scale[:, None, None]
    single = torch.where(seen[..., None], radiance / s, torch.nan)
    albedo = single.nanmedian(dim=1, keepdim=True).values.nan_to_num(nan=0.0)
    for _ in range(iterations):
        residual = (radiance - albedo * s) * per_scale
        weighted = used * s / (1 + residual.square())
        square = (weighted * s).sum(dim=1, keepdim=True)
        albedo = (weighted * radiance).sum(dim=1, keepdim=True) / torch.where(square > 0, square, 1)
    residual = (radiance - albedo * s) * per_scale
    return 0.5 * (used * torch.log1p(residual.square())).sum(dim=1)


def best_views(
    score: PerView, usable: SeenBy, count: int
) -> tuple[Int[Tensor, "sample chosen"], Bool[Tensor, "sample chosen"]]:
    """Return, for every sample, at most ``count`` usable views with the best scores.

    Returns:
        The views, and a mask that is False for padding, where a sample has fewer usable views.

    >>> score = torch.tensor([[0.5, 0.9, 0.7]])
    >>> best_views(score, torch.tensor([[True, True, False]]), 2)
    (tensor([[1, 0]]), tensor([[True, True]]))
    """
    score = torch.where(usable, score, -torch.inf)
    best = score.topk(min(count, score.shape[1]), dim=1)
    return best.indices, best.values > -torch.inf


def poses_first(score: PerView, usable: SeenBy, poses: Int[Tensor, " view"]) -> PerView:
    """Return scores that rank the best view of every pose above the second best of any.

    Views of the same pose agree at every height, so they do not determine it.

    Args:
        score: In [0, 1].

    Returns:
        The score minus the number of better usable views of the same pose.

    >>> score, poses = torch.tensor([[0.9, 0.8, 0.3]]), torch.tensor([0, 0, 1])
    >>> poses_first(score, torch.ones(1, 3, dtype=torch.bool), poses)
    tensor([[ 0.9000, -0.2000,  0.3000]])
    """
    candidates = torch.where(usable, score, -torch.inf)
    result = score.clone()
    for pose in sorted(set(poses.tolist())):
        (views,) = torch.nonzero(poses == pose, as_tuple=True)
        order = candidates[:, views].argsort(dim=1, descending=True, stable=True)
        result[:, views] -= order.argsort(dim=1)
    return result


def view_scores(facing: PerView, footprint: PerView, shading: PerView) -> PerView:
    """Return scores of views by angle, resolution and light; at most 1.

    Args:
        facing: Cosine between the normal and the direction to the camera.
        footprint: Pixels that a sample would span if it faced the camera; above 1 counts as 1.
        shading: Radiance for albedo 1; the mean over views and more count as 1.
    """
    typical = shading.clamp_min(0).mean(dim=1, keepdim=True)
    lit = shading / torch.where(typical > 0, typical, 1)
    return facing * footprint.clamp_max(1) * lit.clamp(0, 1)


# Distance between heights, in samples of the template. A choice.
STEP = 0.7

# Least cosine of the viewing angle, 87 degrees, for the pyramid level of a lookup.
_MIN_FACING = 0.05


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Hypotheses(Record):
    """Heights to compare for a bucket's samples, with the data for it.

    Attributes:
        registered: Valid samples of each view.
        outward: Unit normals along which samples are moved, patch frame.
        cameras: Those of the bucket's views.
        images: Index of each camera's photograph among the sources.
        poses: Index of each view's pose; None if every view has its own.
        ladder: Heights, in steps.
        scale: Scale of the robust cost, in units of radiance.
    """

    templates: Templates
    registered: Observations
    photometry: Photometry
    outward: Float[Tensor, "patch height width 3"]
    cameras: Cameras
    sources: Sources
    images: Int[Tensor, " view"]
    poses: Int[Tensor, " view"] | None
    ladder: Float[Tensor, " hypothesis"]
    scale: Float[Tensor, " patch"]

    @property
    def lights(self) -> tuple[Float[Tensor, "patch view 4"], Float[Tensor, "patch view"]]:
        """Lights divided by the exposure of their views, and the factors of radiance for it."""
        lights, exposure = self.photometry.lights_patch, self.photometry.exposure
        gains = torch.ones_like(lights[..., 0]) if exposure is None else 1 / exposure
        return lights * gains[..., None], gains


Costs = tuple[Float[Tensor, "patch hypothesis height width"], Float[Tensor, "patch height width"]]


def costs_of(hypotheses: Hypotheses, num_views: int, min_views: int) -> Costs:
    """Return the robust cost of every height, and 1 where a sample is swept, else 0.

    Args:
        num_views: Largest number of views in which a sample is compared.
        min_views: Least number of views of a sample that is swept.
    """
    gray = hypotheses.sources.gray.finest
    if gray.dtype == torch.float32 and compiled_for(gray.detach()):
        return _compiled_costs(hypotheses, num_views, min_views)
    return _reference_costs(hypotheses, num_views, min_views)


def _compiled_costs(bucket: Hypotheses, num_views: int, min_views: int) -> Costs:
    from pimper_torch.stages.sweep.kernels import sweep_costs

    templates, photometry, gray = bucket.templates, bucket.photometry, bucket.sources.gray
    to_patches = bucket.cameras, templates.patch_from_world
    projection, centers = image_from_patch(*to_patches), centers_in_patches(*to_patches)
    intrinsics = bucket.cameras.intrinsics.double()
    focals = (intrinsics[:, 0, 0] * intrinsics[:, 1, 1]).sqrt()
    placed, samples = kernel_geometry(bucket.images, templates, bucket.outward, projection, centers)
    light = photometry.normals_patch, *bucket.lights
    trial = sweep_costs.Trial(
        as_array(photometry.observed & templates.inside),
        as_array(bucket.registered.valid),
        as_array(bucket.scale, torch.float32),
        as_array(STEP * bucket.ladder, torch.float64),
        as_array(torch.zeros(0, dtype=torch.long) if bucket.poses is None else bucket.poses),
        num_views,
        min_views,
        _MIN_FACING,
    )
    shading = sweep_costs.Shading(*(as_array(values, torch.float32) for values in light))
    table, lengths = as_array(gray.table), as_array(focals)
    cost, swept = _Compiled.apply(  # type: ignore[no-untyped-call]
        sweep_costs.Sweep(gray.pictures, table, placed, lengths, samples, shading, trial),
        gray.finest.flatten(1),
        gray.coarser,
        projection.flatten(0, 1),
        centers.flatten(0, 1),
        focals,
        templates.origin,
        templates.spacing,
        templates.depth,
        bucket.outward,
        *light,
        bucket.scale,
    )
    return cost.to(templates.depth), swept.to(templates.depth)


class _Compiled(torch.autograd.Function):
    """Costs as a function of images, geometry and light, by a kernel and its adjoint."""

    @staticmethod
    def forward(ctx: Any, call: Any, *inputs: Tensor) -> Costs:
        """Return the costs, and 1 for samples that are swept, else 0."""
        from pimper_torch.stages.sweep.kernels import sweep_costs

        num_patches, _, *raster = call.trial.valid.shape
        cost = torch.zeros(num_patches, len(call.trial.ladder), *raster)
        swept = torch.zeros(num_patches, *raster)
        sweep_costs.costs(call, as_array(cost), as_array(swept))
        ctx.call = call
        ctx.save_for_backward(*inputs)
        ctx.mark_non_differentiable(swept)
        return cost, swept

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, on_cost: Tensor, _: Tensor | None) -> tuple[Tensor | None, ...]:
        """Return gradients of images, geometry and light."""
        load(("sweep_adjoint",))
        from pimper_torch.stages.sweep.kernels import sweep_adjoint as adjoint

        of_images = any(ctx.needs_input_grad[1:3])

        def add_to(*arrays: _Array) -> None:
            gradients = adjoint.CostGradients(*arrays)
            adjoint.pull_back_costs(ctx.call, as_array(on_cost), int(of_images), gradients)

        return None, *pulled_back(add_to, ctx.saved_tensors, of_images)


def _reference_costs(bucket: Hypotheses, num_views: int, min_views: int) -> Costs:
    templates, cameras, poses = bucket.templates, bucket.cameras, bucket.poses
    tested = bucket.photometry.observed & templates.inside
    tested = tested & (bucket.registered.valid.sum(dim=1) >= min_views)
    (index,) = torch.nonzero(tested.flatten(), as_tuple=True)
    patch = index // tested[0].numel()
    world_from_patch = invert_rigid(templates.patch_from_world)
    points = transform(world_from_patch, templates.points_patch.flatten(1, 2))
    outward = rotate(world_from_patch, bucket.outward.flatten(1, 2))
    points, outward = points.reshape(-1, 3)[index], outward.reshape(-1, 3)[index]
    normals = bucket.photometry.normals_patch.reshape(-1, 3)[index]
    basis = torch.cat([torch.ones_like(normals[:, :1]), normals], dim=1)
    lights, gains = bucket.lights
    shading = torch.einsum("sga,sa->sg", lights[patch], basis)
    valid = bucket.registered.valid.movedim(1, -1).reshape(-1, cameras.num_views)[index]
    with torch.no_grad():
        away = cameras.centers_world - points[:, None]
        facing = (normalize(away, dim=-1) * outward[:, None]).sum(dim=-1)
        footprint = _footprint(points, templates.spacing[patch], cameras)
        score = view_scores(facing, footprint, shading)
        usable = valid & (facing > 0) & (shading > 0)
        if poses is not None:
            score = poses_first(score, usable, poses)
        chosen, seen = best_views(score, usable, num_views)
        enough = seen.sum(dim=1) >= min_views
        if poses is not None:
            enough = (seen & (score.gather(1, chosen) > 0)).sum(dim=1) >= min_views
    index, patch, chosen, seen = index[enough], patch[enough], chosen[enough], seen[enough]
    points, outward = points[enough], outward[enough]
    radiance = _look_up(bucket, patch, points, outward, torch.where(seen, chosen, -1))
    radiance = gains[patch].gather(1, chosen)[..., None] * radiance
    shading = shading[enough].gather(1, chosen)
    cost = inconsistency(radiance, shading, seen, bucket.scale[patch])
    raster = templates.depth
    flat = cost.new_zeros(raster.numel(), cost.shape[1]).index_copy(0, index, cost)
    swept = torch.zeros_like(raster).flatten().index_fill(0, index, 1.0)
    return flat.reshape(*raster.shape, -1).movedim(-1, 1), swept.reshape(raster.shape)


def _footprint(points: Float[Tensor, "sample 3"], spacing: PerSample, cameras: Cameras) -> PerView:
    """Return the pixels that a sample would span in each view if it faced it."""
    focal = (cameras.intrinsics[:, 0, 0] * cameras.intrinsics[:, 1, 1]).sqrt()
    axes = cameras.cam_from_world[:, 2]
    depth = points @ axes[:, :3].mT + axes[:, 3]
    return spacing[:, None] * focal / depth.clamp_min(torch.finfo(depth.dtype).eps)


def _look_up(
    bucket: Hypotheses,
    patch: Int[Tensor, " sample"],
    points: Float[Tensor, "sample 3"],
    outward: Float[Tensor, "sample 3"],
    chosen: Int[Tensor, "sample chosen"],
) -> Float[Tensor, "sample chosen hypothesis"]:
    """Return radiances of samples (world frame) at all heights in their views; -1 is padding."""
    spacing = bucket.templates.spacing[patch]
    moves = STEP * spacing[:, None] * bucket.ladder.to(spacing)
    radiance = moves.new_zeros(*chosen.shape, moves.shape[1]).flatten(0, 1)
    for view in range(bucket.cameras.num_views):
        (slot,) = torch.nonzero((chosen == view).flatten(), as_tuple=True)
        if len(slot) == 0:
            continue
        sample = slot // chosen.shape[1]
        start, along = points[sample], outward[sample]
        moved = start[:, None] + moves[sample, :, None] * along[:, None]
        camera = bucket.cameras.take([view])
        pixels, _ = project(moved.reshape(-1, 3), camera.cam_from_world[0], camera.intrinsics[0])
        across = _footprint(start, spacing[sample], camera)[:, 0]
        away = normalize(camera.centers_world - start, dim=-1)
        squeezed = (away * along).sum(dim=-1).clamp_min(_MIN_FACING)
        level = (across * squeezed.sqrt()).clamp_min(1).log2()
        level = level[:, None].expand(-1, moves.shape[1]).flatten()
        looked_up = look_up(bucket.sources.gray.levels(int(bucket.images[view])), pixels, level)
        radiance = radiance.index_copy(0, slot, looked_up.reshape(len(slot), -1).to(radiance))
    return radiance.reshape(*chosen.shape, moves.shape[1])
