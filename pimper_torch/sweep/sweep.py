"""The stage that finds heights: every place is looked up again, higher and lower, under its light."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import normalize

from pimper_torch.config import require
from pimper_torch.geometry.frames import invert_rigid, rotate, transform
from pimper_torch.geometry.projection import project
from pimper_torch.patches.carry import carried_normals
from pimper_torch.patches.pyramid import image_pyramid, pyramid_level, sample_pyramid
from pimper_torch.progress import track
from pimper_torch.radiometry import SATURATED
from pimper_torch.records import (
    Cameras,
    Heights,
    PatchViews,
    PhotometricPatches,
    Photometry,
    Registered,
    SweptPatches,
    Templates,
    Views,
)
from pimper_torch.sweep.consistency import inconsistency
from pimper_torch.sweep.minimum import parabola_minimum, posterior_variance
from pimper_torch.sweep.selection import best_views
from pimper_torch.sweep.windows import level_weight, window_mean


# So many samples err alike, as they were looked up between the same pixels, blurred.
CORRELATED_SAMPLES = 4.0


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepConfig:
    """Which heights are tried, and how they are judged.

    Attributes:
        steps: Tried on each side of the template.
        step_samples: Between them, in samples of the template.
        window_samples: Standard deviation of the window that costs are averaged over.
        num_views: At most so many views judge a sample.
        loss_scale: Of the robust cost, in standard deviations of the patch's residuals.
        min_views: A sample that fewer views may judge is left where it is.
        steepest: Slope of the template, off its facet, at which a window ends.
    """

    steps: int = 4
    step_samples: float = 0.7
    window_samples: float = 1.5
    num_views: int = 16
    loss_scale: float = 2.0
    min_views: int = 3
    steepest: float = 4.0
    pyramid_levels: int = 4
    saturation_level: float = SATURATED

    def __post_init__(self) -> None:
        require(self.steps >= 1, "sweep.steps", self.steps, "1 or more")
        require(self.num_views >= 2, "sweep.num_views", self.num_views, "2 or more")
        require(self.min_views >= 2, "sweep.min_views", self.min_views, "2 or more")
        for name in ("step_samples", "window_samples", "loss_scale", "steepest"):
            require(getattr(self, name) > 0, f"sweep.{name}", getattr(self, name), "above 0")


class Sweep(nn.Module):
    """Sweep every template along its normals, and keep the height that views agree on."""

    def __init__(self, config: SweepConfig | None = None) -> None:
        super().__init__()
        self.config = config or SweepConfig()

    def forward(
        self, views: Views, cameras: Cameras, seen: PatchViews, photometric: PhotometricPatches
    ) -> SweptPatches:
        """Sweep all patches."""
        config = self.config
        pyramid = image_pyramid(views, config.saturation_level, config.pyramid_levels)
        gray = [
            torch.cat([level[:, :-1].mean(dim=1, keepdim=True), level[:, -1:]], dim=1)
            for level in pyramid
        ]
        coarse = photometric.patches.coarse
        triples = list(
            zip(photometric.patches.buckets, seen.buckets, photometric.buckets, strict=True)
        )
        buckets = [
            self._sweep(*triple, carried_normals(coarse, triple[0]), cameras, gray)
            for triple in track(triples)
        ]
        return SweptPatches(photometric=photometric, buckets=tuple(buckets))

    def _sweep(
        self,
        templates: Templates,
        registered: Registered,
        photometry: Photometry,
        carried: Float[Tensor, "patch height width 3"],
        cameras: Cameras,
        pyramid: list[Float[Tensor, "view 2 _ _"]],
    ) -> Heights:
        config = self.config
        num, height, width = templates.depth.shape
        world_from_patch = invert_rigid(templates.patch_from_world)
        flat = templates.points_patch.reshape(num, -1, 3)
        places = transform(world_from_patch, flat)
        outward = rotate(world_from_patch, carried.detach().reshape(num, -1, 3))
        basis = torch.cat([torch.ones_like(carried[..., :1]), photometry.normals_patch], dim=-1)
        shading = torch.einsum("pga,phwa->pghw", photometry.lights_patch, basis)
        facing = self._facing(places, outward, cameras).reshape(num, -1, height, width)
        usable = registered.valid & (shading > 0) & photometry.valid[:, None]
        usable = best_views(facing, usable, config.num_views)
        count = usable.sum(dim=1)
        usable = usable & (count >= config.min_views)[:, None]

        step = config.step_samples * templates.spacing
        ladder = torch.arange(-config.steps, config.steps + 1).to(step)
        moves = step[:, None] * ladder
        spread = photometry.convergence.residual.clamp_min(1e-4)
        looked = []
        for view in range(cameras.num_views):
            if not bool(usable[:, view].any()):
                looked.append(shading.new_zeros(num, len(ladder), height, width))
                continue
            looked.append(
                self._look_up(view, places, outward, moves, (height, width), cameras, pyramid)
            )
        radiance = torch.stack(looked, dim=1)
        cost = inconsistency(radiance, shading, usable, config.loss_scale * spread)
        # In units of the variance: Cauchy's cost near zero is r^2 / (2 c^2).
        cost = cost * config.loss_scale**2
        window = level_weight(
            templates.depth.detach(), templates.inside & usable.any(dim=1), templates.spacing,
            config.steepest,
        )
        averaged = 4 * math.pi * config.window_samples**2
        cost = window_mean(cost, window, config.window_samples) * (averaged / CORRELATED_SAMPLES)
        place, curvature, found = parabola_minimum(cost)
        with torch.no_grad():
            variance = posterior_variance(cost, curvature)
            uniform = ((2 * config.steps + 1) ** 2 - 1) / 12
            told = (1 / variance - 1 / uniform).clamp_min(0) / averaged
        found = found & (window > 0) & (told > 0)
        offset = (place - config.steps) * step[:, None, None]
        information = told / step[:, None, None].square()
        least = cost.detach().amin(dim=1)
        return Heights(
            offset=torch.where(found, offset, 0),
            information=torch.where(found, information, 0),
            misfit=torch.where(found, least, 0),
        )

    def _facing(
        self,
        places: Float[Tensor, "patch sample 3"],
        outward: Float[Tensor, "patch sample 3"],
        cameras: Cameras,
    ) -> Float[Tensor, "patch view sample"]:
        return torch.stack(
            [
                (normalize(center - places, dim=-1) * outward).sum(dim=-1)
                for center in cameras.centers_world
            ],
            dim=1,
        )

    def _look_up(
        self,
        view: int,
        places: Float[Tensor, "patch sample 3"],
        outward: Float[Tensor, "patch sample 3"],
        moves: Float[Tensor, "patch hypothesis"],
        raster: tuple[int, int],
        cameras: Cameras,
        pyramid: list[Float[Tensor, "view 2 _ _"]],
    ) -> Float[Tensor, "patch hypothesis height width"]:
        height, width = raster
        num, tried = moves.shape
        camera = cameras.cam_from_world[view], cameras.intrinsics[view]
        moved = places[:, None] + moves[:, :, None, None] * outward[:, None]
        pixels, _ = project(moved.reshape(-1, 3), *camera)
        pixels = pixels.reshape(num, tried * height, width, 2)
        level = pyramid_level(pixels.reshape(num * tried, height, width, 2)[: 0 + num * tried])
        level = level.detach().reshape(num, tried * height, width)
        sampled = sample_pyramid([images[view, :1] for images in pyramid], pixels, level)
        return sampled[:, 0].reshape(num, tried, height, width)
