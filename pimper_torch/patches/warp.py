"""Registration: every view resampled on every template, the matrices J and D."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import interpolate, normalize

from pimper_torch.config import require
from pimper_torch.geometry.frames import invert_rigid, rotate, transform
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.patches.pyramid import image_pyramid, look_up, pyramid_level
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
        pyramid = image_pyramid(views, self.config.saturation_level, self.config.pyramid_levels)
        mesh = patches.surface or patches.coarse.mesh
        caster = RayCaster(mesh.vertices_world, mesh.faces)
        return PatchViews(
            patches=patches,
            buckets=tuple(
                self._register(bucket, cameras, pyramid, caster)
                for bucket in track(patches.buckets)
            ),
        )

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
        outward = -world_from_patch[:, None, None, :3, 2].expand_as(points_world)
        if templates.normals_patch is not None:
            carried = templates.normals_patch.detach().reshape(num, -1, 3)
            outward = rotate(world_from_patch, carried).reshape(points_world.shape)
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
        outward: Float[Tensor, "patch height width 3"],
        cameras: Cameras,
        pyramid: list[Float[Tensor, "view channels _ _"]],
        caster: RayCaster,
    ) -> tuple[Float[Tensor, "patch channel height width"], Bool[Tensor, "patch height width"]]:
        center = cameras.centers_world[view]
        facing = (normalize(center - points_world, dim=-1) * outward).sum(-1)
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
        # A sample whose footprint touches the border, or is unusable by a tenth, is missing.
        margin = 0.5 * 2 ** level.detach()[..., None]
        size = cameras.sizes_px[view].to(pixels)
        within = ((pixels >= margin) & (pixels <= size - margin)).all(dim=-1)
        wanted = wanted & within
        found = look_up([images[view] for images in pyramid], pixels[wanted], level[wanted])
        usable = (found[:, -1] < 0.1) & (found[:, :-1].mean(dim=1) > self.config.dark_level)
        radiance = found.new_zeros(*wanted.shape, found.shape[1] - 1)
        radiance = radiance.index_put((wanted,), found[:, :-1]).movedim(-1, 1)
        valid = torch.zeros_like(wanted).index_put((wanted,), usable)
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


def missing_share(seen: PatchViews) -> float:
    """Give the share of the enlarged triangles' samples, over all views, that is missing."""
    pairs = list(zip(seen.patches.buckets, seen.buckets, strict=True))
    samples = sum(int(t.inside.sum()) * r.valid.shape[1] for t, r in pairs)
    return 1 - sum(int(registered.valid.sum()) for _, registered in pairs) / samples
