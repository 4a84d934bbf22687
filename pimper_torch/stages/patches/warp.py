"""Registration: every view resampled on every template, the matrices J and D."""

import math
from functools import partial
from typing import Any

import torch
from jaxtyping import Int
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import interpolate, normalize

from pimper_torch.geometry.projection import project
from pimper_torch.geometry.pyramids import (
    Sources,
    build_pyramids,
    centers_in_patches,
    image_from_patch,
    kernel_geometry,
    look_up,
    pyramid_level,
)
from pimper_torch.geometry.rigid import invert_rigid, rotate, transform
from pimper_torch.geometry.visibility import RayCaster, ray_caster
from pimper_torch.kernels.arrays import as_array, pulled_back
from pimper_torch.kernels.compile import PHOTOMETRY, load
from pimper_torch.kernels.signatures import FractionRows, PictureRows, Projection, Samples
from pimper_torch.kernels.switch import compiled_for
from pimper_torch.records import (
    Cameras,
    Observations,
    PatchPriors,
    PatchSet,
    PatchViews,
    Templates,
    Views,
)
from pimper_torch.records.shapes import PatchMask, PatchMasks
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.stages.patches.patches_config import WarpConfig
from pimper_torch.stages.patches.template_priors import merged
from pimper_torch.stages.stage import Stage

_Array = NDArray[Any]
# Arguments of the kernel.
_Call = tuple[PictureRows, FractionRows, _Array, Projection, Samples, _Array, _Array, float, float]


def resampled(
    cameras: Cameras,
    sources: Sources,
    templates: Templates,
    rows: Int[Tensor, " view"],
    min_facing: float,
    dark_level: float,
) -> Observations:
    """Return the samples of views on a bucket of templates, without occlusion.

    Pixels are computed in float64, and images are sampled in float32. Differentiable once.

    Args:
        rows: Index of each camera's photograph among the sources.
        min_facing: Least cosine of the angle between a normal and the direction to the camera.
        dark_level: Radiance at or below which a sample is invalid.
    """
    outward = templates.normals_patch
    if outward is None:
        outward = templates.depth.new_tensor([0, 0, -1]).expand(*templates.depth.shape, 3)
    images, projection = sources.images, image_from_patch(cameras, templates.patch_from_world)
    centers = centers_in_patches(cameras, templates.patch_from_world)
    geometry = kernel_geometry(rows, templates, outward, projection, centers)
    call = images.pictures, sources.unusable.fractions, as_array(images.table), *geometry
    limits = as_array(cameras.sizes_px), as_array(templates.inside), min_facing, dark_level
    radiance, valid = _Resampled.apply(  # type: ignore[no-untyped-call]
        (*call, *limits),
        images.finest.shape[1],
        images.finest.flatten(1),
        images.coarser,
        projection.flatten(0, 1),
        templates.origin,
        templates.spacing,
        templates.depth,
    )
    return Observations(radiance=radiance, valid=valid)


class _Resampled(torch.autograd.Function):
    """Samples as a function of images and geometry, by a kernel and its adjoint."""

    @staticmethod
    def forward(ctx: Any, call: _Call, channels: int, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return the samples, and the mask of valid ones."""
        from pimper_torch.stages.patches.kernels import resampling

        projection, depth = call[3], inputs[-1]
        num_patches, *raster = depth.shape
        radiance = torch.empty(num_patches, len(projection.rows), channels, *raster)
        valid = torch.empty(num_patches, len(projection.rows), *raster, dtype=torch.bool)
        resampling.resample_views(*call, as_array(radiance), as_array(valid))
        ctx.call = call
        ctx.save_for_backward(valid, *inputs)
        ctx.mark_non_differentiable(valid)
        return radiance, valid

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, on_radiance: Tensor, _: Tensor | None) -> tuple[Tensor | None, ...]:
        """Return gradients of images and geometry."""
        load(("resampling_adjoint",))
        from pimper_torch.stages.patches.kernels import resampling_adjoint as adjoint

        valid, *inputs = ctx.saved_tensors
        pictures, _, levels, projection, samples, *_ = ctx.call
        call = pictures, levels, projection, samples, as_array(valid), as_array(on_radiance)
        of_images = any(ctx.needs_input_grad[2:4])

        def add_to(*arrays: _Array) -> None:
            adjoint.pull_back_resampling(*call, int(of_images), adjoint.ViewGradients(*arrays))

        return None, None, *pulled_back(add_to, inputs, of_images)


def occluded(
    valid: PatchMasks, cameras: Cameras, caster: RayCaster, templates: Templates, stride: int
) -> PatchMasks:
    """Return the samples that a surface occludes. Not differentiable.

    A ray is cast for every block of ``stride`` by ``stride`` samples with a valid one, from the
    camera to just in front of the surface.
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
    blocks = valid.new_zeros(shape).index_add_(2, rows, valid)
    blocks = blocks.new_zeros(*blocks.shape[:3], points.shape[2]).index_add_(3, columns, blocks)
    patch, view, row, column = blocks.nonzero(as_tuple=True)
    starts = cameras.centers_world.detach().double()[view]
    directions = points[patch, row, column] - starts
    length = directions.norm(dim=1)
    # An enlarged triangle extends below its neighbours, by the overlap times their slope.
    reach = (length - 4 * stride * templates.spacing.detach()[patch]).clamp_min(0)
    blocks[patch, view, row, column] = caster.blocked(starts, directions / length[:, None], reach)
    return blocks[:, :, rows][..., columns]


def _nearest_site(sites: int, samples: int) -> Int[Tensor, " sample"]:
    index = torch.arange(sites, dtype=torch.float32)[None, None]
    return interpolate(index, size=samples, mode="nearest-exact")[0, 0].long()


class Warp(Stage):
    """Resample all views on all templates.

    Perspective-correct, because the 3D point of each sample is projected; anti-aliased, because
    the pyramid level is selected by the pixels that a sample covers. Invalid samples are outside
    the frame or the mask, grazing or back-facing, occluded, too dark, saturated, or not finite.

    Differentiable in the images and in the templates' depth; the mask of valid samples is constant.
    """

    kernels = PHOTOMETRY

    def __init__(self, config: WarpConfig | None = None) -> None:
        super().__init__()
        self.config = config or WarpConfig()

    def forward(
        self, views: Views, cameras: Cameras, patches: PatchSet, sources: Sources | None = None
    ) -> PatchViews:
        """Return J and D of every patch.

        Args:
            patches: All patches, or a subset of buckets.
            sources: As :func:`~pimper_torch.geometry.pyramids.build_pyramids` returns; or computed.
        """
        sources = sources or build_pyramids(views, self.config.saturation_level)
        caster = ray_caster(patches.surface or patches.coarse.mesh)
        registered = partial(self._registered, cameras, sources, caster)
        buckets = tuple(side_by_side(registered, patches.buckets))
        return PatchViews(patches=patches, buckets=buckets)

    def _registered(
        self, cameras: Cameras, sources: Sources, caster: RayCaster, templates: Templates
    ) -> Observations:
        rows, cameras = templates.rows(cameras.num_views), templates.own(cameras)
        if sources.lights is not None:
            sources = sources.replace(lights=templates.own(sources.lights))
        samples = self._resampled(cameras, sources, rows, templates, self.config.dark_level)
        prior_samples = [
            (maps, self._resampled(maps.cameras(cameras), maps.maps, index, templates, -math.inf))
            for maps, index in (prior.of(rows) for prior in sources.priors)
            if len(index)
        ]
        tested = samples.valid
        for maps, looked_up in prior_samples:
            tested = tested.index_add(1, maps.view, looked_up.valid)
        stride = self.config.occlusion_stride
        hidden = occluded(tested, cameras, caster, templates, stride)
        samples.radiance.masked_fill_(hidden[:, :, None], 0)
        priors: PatchPriors | None = None
        if prior_samples or sources.lights is not None:
            priors = merged(prior_samples, hidden, cameras, templates, sources.lights)
        valid = samples.valid & ~hidden
        total = int(templates.inside.sum()) * cameras.num_views
        leave_out("warp", total - int(valid.count_nonzero()), total=total)
        centers = cameras.centers_world.to(templates.patch_from_world)
        viewers = transform(
            templates.patch_from_world, centers.expand(len(templates.facet), -1, -1)
        )
        viewers = normalize(viewers, dim=-1).to(samples.radiance)
        return samples.replace(valid=valid, priors=priors, viewers=viewers)

    def _resampled(
        self,
        cameras: Cameras,
        sources: Sources,
        rows: Int[Tensor, " view"],
        templates: Templates,
        dark_level: float,
    ) -> Observations:
        """Return samples of views on a bucket, without occlusion; ``rows`` index the sources."""
        images = sources.images.finest
        if images.dtype == torch.float32 and compiled_for(images.detach()):
            steepest = math.cos(math.radians(self.config.max_tilt_deg))
            return resampled(cameras, sources, templates, rows, steepest, dark_level)
        world_from_patch = invert_rigid(templates.patch_from_world)
        points = transform(world_from_patch, templates.points_patch.flatten(1, 2))
        points_world = points.reshape(*templates.depth.shape, 3)
        outward = -world_from_patch[:, None, None, :3, 2].expand_as(points_world)
        if templates.normals_patch is not None:
            transferred = templates.normals_patch.detach().flatten(1, 2)
            outward = rotate(world_from_patch, transferred).reshape(points_world.shape)

        def sample(view: int, row: int) -> tuple[Tensor, PatchMask]:
            center = cameras.centers_world[view]
            facing = (normalize(center - points_world, dim=-1) * outward).sum(-1)
            steepest = torch.deg2rad(facing.new_tensor(self.config.max_tilt_deg)).cos()
            pixels, depth = project(
                points_world.reshape(-1, 3), cameras.cam_from_world[view], cameras.intrinsics[view]
            )
            pixels = pixels.reshape(*facing.shape, 2)
            wanted = templates.inside & (facing > steepest) & (depth.reshape(facing.shape) > 0)
            if not wanted.any():
                return images.new_zeros(len(facing), images.shape[1], *facing.shape[1:]), wanted
            level = pyramid_level(pixels)
            # A sample is invalid if its footprint touches the border, or a tenth of it is unusable.
            margin = 0.5 * 2 ** level.detach()[..., None]
            size = cameras.sizes_px[view].to(pixels)
            wanted = wanted & ((pixels >= margin) & (pixels <= size - margin)).all(dim=-1)
            values = look_up(sources.images.levels(row), pixels[wanted], level[wanted])
            fractions = [fraction.to(values) for fraction in sources.unusable.levels(row)]
            lost = look_up(fractions, pixels[wanted].detach(), level[wanted].detach())[:, 0] / 255
            usable = (lost < 0.1) & (values.mean(dim=1) > dark_level)
            radiance = values.new_zeros(*wanted.shape, values.shape[1])
            radiance = radiance.index_put((wanted,), values).movedim(-1, 1)
            valid = torch.zeros_like(wanted).index_put((wanted,), usable)
            return radiance * valid[:, None], valid

        per_view = [sample(view, row) for view, row in enumerate(rows.tolist())]
        radiance, valid = (torch.stack(values, dim=1) for values in zip(*per_view, strict=True))
        return Observations(radiance=radiance, valid=valid)
