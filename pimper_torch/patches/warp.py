"""Registration: every view resampled on every template, the matrices J and D."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from kornia.geometry.transform import pyrdown, remap
from torch import Tensor, nn
from torch.nn.functional import interpolate, normalize

from pimper_torch.config import require
from pimper_torch.geometry.frames import invert_rigid, transform
from pimper_torch.geometry.pixels import grid_from_pixels
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.progress import track
from pimper_torch.radiometry import SATURATED
from pimper_torch.records import (
    Cameras,
    PatchSet,
    PatchViews,
    Registered,
    Templates,
    Views,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class WarpConfig:
    """Which samples a view is allowed to contribute.

    Attributes:
        dark_level: Radiance at or below which a sample is missing; 1 is saturation.
        saturation_level: Radiance at or above which a pixel of any channel is missing.
        max_tilt_deg: A facet turned further from a view is not used there.
        occlusion_stride: Samples between the rays that test for occlusion.
        pyramid_levels: How often an image may be halved for templates it sees from close.
    """

    dark_level: float = 0.01
    saturation_level: float = SATURATED
    max_tilt_deg: float = 75.0
    occlusion_stride: int = 4
    pyramid_levels: int = 4

    def __post_init__(self) -> None:
        require(0 <= self.dark_level < 1, "dark_level", self.dark_level, "in [0, 1)")
        require(
            self.saturation_level > self.dark_level,
            "saturation_level",
            self.saturation_level,
            f"above dark_level {self.dark_level}",
        )
        require(0 < self.max_tilt_deg < 90, "max_tilt_deg", self.max_tilt_deg, "in (0, 90)")
        require(self.occlusion_stride >= 1, "occlusion_stride", self.occlusion_stride, ">= 1")
        require(self.pyramid_levels >= 1, "pyramid_levels", self.pyramid_levels, ">= 1")


class Warp(nn.Module):
    """Resample all views on all templates.

    Perspective-correct, because each sample's own 3D point is projected; anti-aliased,
    because the level of an image pyramid is chosen by the pixels that a sample covers.
    Missing: outside the frame or the mask, grazing or back-facing, behind another facet,
    too dark, saturated, not finite.

    Differentiable in the images and in the templates' depth; what is missing is a constant.
    """

    def __init__(self, config: WarpConfig | None = None) -> None:
        super().__init__()
        self.config = config or WarpConfig()

    def forward(self, views: Views, cameras: Cameras, patches: PatchSet) -> PatchViews:
        """Give J and D of every patch."""
        pyramid = self._pyramid(views)
        mesh = patches.coarse.mesh
        caster = RayCaster(mesh.vertices_world, mesh.faces)
        return PatchViews(
            patches=patches,
            buckets=tuple(
                self._register(bucket, cameras, pyramid, caster)
                for bucket in track(patches.buckets)
            ),
        )

    def _pyramid(self, views: Views) -> list[Float[Tensor, "view channels _ _"]]:
        """Halve the images again and again; the last channel is 1 where a pixel is unusable."""
        usable = views.inside
        if views.masks is not None:
            usable = usable & views.masks
        finite = views.images.isfinite()
        usable = usable & finite.all(dim=1)
        usable = usable & (views.images.amax(dim=1) < self.config.saturation_level)
        # NaN times a weight of 0 is NaN: zeros, which are marked, spread nothing.
        images = torch.where(finite, views.images, 0)
        levels = [torch.cat([images, (~usable)[:, None].to(images)], dim=1)]
        while len(levels) < self.config.pyramid_levels and min(levels[-1].shape[-2:]) >= 8:
            levels.append(pyrdown(levels[-1]))
        return levels

    def _register(
        self,
        templates: Templates,
        cameras: Cameras,
        pyramid: list[Float[Tensor, "view channels _ _"]],
        caster: RayCaster,
    ) -> Registered:
        world_from_patch = invert_rigid(templates.patch_from_world)
        num, height, width = templates.depth.shape
        points = transform(world_from_patch, templates.points_patch.reshape(num, -1, 3))
        points_world = points.reshape(num, height, width, 3)
        outward = -world_from_patch[:, :3, 2]
        seen = [
            self._seen_by(view, templates, points_world, outward, cameras, pyramid, caster)
            for view in range(cameras.num_views)
        ]
        return Registered(
            radiance=torch.stack([radiance for radiance, _ in seen], dim=1),
            valid=torch.stack([valid for _, valid in seen], dim=1),
        )

    def _seen_by(
        self,
        view: int,
        templates: Templates,
        points_world: Float[Tensor, "patch height width 3"],
        outward: Float[Tensor, "patch 3"],
        cameras: Cameras,
        pyramid: list[Float[Tensor, "view channels _ _"]],
        caster: RayCaster,
    ) -> tuple[Float[Tensor, "patch channel height width"], Bool[Tensor, "patch height width"]]:
        center = cameras.centers_world[view]
        facing = (normalize(center - points_world, dim=-1) * outward[:, None, None]).sum(-1)
        steepest = torch.deg2rad(facing.new_tensor(self.config.max_tilt_deg)).cos()
        pixels, depth = project(
            points_world.reshape(-1, 3), cameras.cam_from_world[view], cameras.intrinsics[view]
        )
        pixels = pixels.reshape(*points_world.shape[:-1], 2)
        wanted = templates.inside & (facing > steepest) & (depth.reshape(facing.shape) > 0)
        if not wanted.any():
            channels = pyramid[0].shape[1] - 1
            return pyramid[0].new_zeros(len(facing), channels, *facing.shape[1:]), wanted
        level = pyramid_level(pixels)
        sampled = sample_pyramid([images[view] for images in pyramid], pixels, level)
        radiance, unusable = sampled[:, :-1], sampled[:, -1]
        # A sample whose footprint touches the border, or is unusable by a tenth, is missing.
        margin = 0.5 * 2 ** level.detach()[..., None]
        size = cameras.sizes_px[view].to(pixels)
        within = ((pixels >= margin) & (pixels <= size - margin)).all(dim=-1)
        valid = wanted & within & (unusable < 0.1)
        valid = valid & (radiance.mean(dim=1) > self.config.dark_level)
        valid = valid & ~self._hidden(templates, points_world, center, caster, valid)
        return radiance * valid[:, None], valid

    def _hidden(
        self,
        templates: Templates,
        points_world: Float[Tensor, "patch height width 3"],
        center: Float[Tensor, " 3"],
        caster: RayCaster,
        asked: Bool[Tensor, "patch height width"],
    ) -> Bool[Tensor, "patch height width"]:
        stride = self.config.occlusion_stride
        sparse = points_world[:, stride // 2 :: stride, stride // 2 :: stride]
        if not asked.any() or sparse.numel() == 0:
            return torch.zeros_like(asked)
        # An enlarged triangle dips under its neighbours by the overlap's share of their slope.
        own = 4 * stride * templates.spacing[:, None, None]
        hidden = caster.occluded(sparse, center, own)
        dense = interpolate(hidden[:, None].float(), size=asked.shape[-2:], mode="nearest-exact")
        return dense[:, 0] > 0


def pyramid_level(
    pixels: Float[Tensor, "patch height width 2"],
) -> Float[Tensor, "patch height width"]:
    """Choose the pyramid level at which neighbouring samples are a pixel apart.

    The footprint is the square root of the area of a sample's parallelogram in the image:
    a compromise for oblique facets between blur along one axis and aliasing along the other.
    """
    du = _difference(pixels, dim=2)
    dv = _difference(pixels, dim=1)
    area = (du[..., 0] * dv[..., 1] - du[..., 1] * dv[..., 0]).abs()
    return 0.5 * area.clamp_min(1).log2()


def sample_pyramid(
    pyramid: list[Float[Tensor, "channels _ _"]],
    pixels: Float[Tensor, "patch height width 2"],
    level: Float[Tensor, "patch height width"],
) -> Float[Tensor, "patch channels height width"]:
    """Look an image up, blending the two pyramid levels next to each sample's own.

    Every level covers the same ``[0, width] x [0, height]`` of the finest, so one
    normalised grid serves all.
    """
    num, rows, columns = level.shape
    grid = grid_from_pixels(pixels, width=pyramid[0].shape[-1], height=pyramid[0].shape[-2])
    grid = grid.reshape(1, num * rows, columns, 2).clamp(-3, 3).to(pyramid[0])
    level = level.clamp(0, len(pyramid) - 1).to(pyramid[0])
    total = pyramid[0].new_zeros(num, pyramid[0].shape[0], rows, columns)
    for index, image in enumerate(pyramid):
        weight = (1 - (level - index).abs()).clamp_min(0)
        if not (weight > 0).any():
            continue
        sampled = remap(
            image[None],
            grid[..., 0],
            grid[..., 1],
            mode="bilinear",
            padding_mode="border",
            align_corners=False,
            normalized_coordinates=True,
        )
        sampled = sampled.reshape(-1, num, rows, columns).transpose(0, 1)
        total = total + weight[:, None] * sampled
    return total


def missing_share(seen: PatchViews) -> float:
    """Give the share of the enlarged triangles' samples, over all views, that is missing."""
    pairs = list(zip(seen.patches.buckets, seen.buckets, strict=True))
    samples = sum(int(t.inside.sum()) * r.valid.shape[1] for t, r in pairs)
    return 1 - sum(int(registered.valid.sum()) for _, registered in pairs) / samples


def _difference(
    values: Float[Tensor, "patch height width 2"], dim: int
) -> Float[Tensor, "patch height width 2"]:
    """Take forward differences, the last one repeated; zero along a single sample."""
    steps = values.diff(dim=dim)
    if steps.shape[dim] == 0:
        return torch.zeros_like(values)
    return torch.cat([steps, steps.narrow(dim, steps.shape[dim] - 1, 1)], dim=dim)
