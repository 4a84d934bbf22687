"""Image pyramids of photographs and priors, sampled at each sample's footprint."""

import math
from dataclasses import dataclass, field
from itertools import chain
from typing import Literal

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.nn.functional import conv2d, grid_sample, pad

from pimper_torch.geometry.pixels import grid_from_pixels
from pimper_torch.geometry.rigid import invert_rigid, transform
from pimper_torch.kernels.arrays import as_array
from pimper_torch.kernels.signatures import FractionRows, PictureRows, Projection, Samples
from pimper_torch.radiometry import SATURATED
from pimper_torch.records import (
    AlbedoPrior,
    Cameras,
    DepthPrior,
    InlierPrior,
    LightPrior,
    NormalPrior,
    Record,
    Templates,
    Views,
)
from pimper_torch.records.shapes import PatchRaster, PatchVectors
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.mapped import by_view, each, zeros
from pimper_torch.runtime.parallel import side_by_side


def halve(images: Float[Tensor, "view channels _ _"]) -> Float[Tensor, "view channels _ _"]:
    """Blur and halve images as kornia's ``pyrdown``, in a sixth of the time.

    Burt's binomial filter of five taps and the mean of two pixels are one filter of six taps along
    rows and along columns, at every other pixel. Images with an odd side use ``pyrdown``.
    """
    height, width = images.shape[-2:]
    if height % 2 or width % 2:
        # Slow to import, and rarely used.
        from kornia.geometry.transform import pyrdown

        return pyrdown(images)
    taps = images.new_tensor([1, 5, 10, 10, 5, 1]) / 32
    planes = pad(images.reshape(-1, 1, height, width), (2, 2, 2, 2), mode="reflect")
    planes = conv2d(planes, taps.reshape(1, 1, 1, 6), stride=(1, 2))
    planes = conv2d(planes, taps.reshape(1, 1, 6, 1), stride=(2, 1))
    return planes.reshape(*images.shape[:-2], height // 2, width // 2)


def pyramid_level(pixels: Float[Tensor, "patch height width 2"]) -> PatchRaster:
    """Return the pyramid level at which neighbouring samples are one pixel apart.

    The footprint is the square root of the area of a sample's parallelogram in the image. For
    oblique facets it balances blur along one axis and aliasing along the other.
    """
    du = _difference(pixels, dim=2)
    dv = _difference(pixels, dim=1)
    area = (du[..., 0] * dv[..., 1] - du[..., 1] * dv[..., 0]).abs()
    return 0.5 * area.clamp_min(1).log2()


def look_up(
    pyramid: list[Float[Tensor, "channels _ _"]],
    pixels: Float[Tensor, "sample 2"],
    level: Float[Tensor, " sample"],
) -> Float[Tensor, "sample channels"]:
    """Sample an image, interpolated between the two pyramid levels nearest to each sample's.

    Every level covers the same ``[0, width] x [0, height]`` of the finest, so one normalized grid
    serves all. Differentiable in images and pixels.
    """
    finest = pyramid[0]
    grid = grid_from_pixels(pixels, width=finest.shape[-1], height=finest.shape[-2])
    grid = grid.clamp(-3, 3).to(finest)
    level = level.clamp(0, len(pyramid) - 1).to(finest)
    total = finest.new_zeros(len(grid), len(finest))
    for index, image in enumerate(pyramid):
        weight = (1 - (level - index).abs()).clamp_min(0)
        (samples,) = torch.nonzero(weight > 0, as_tuple=True)
        if len(samples) > 0:
            positions = grid[samples][None, None]
            values = grid_sample(
                image[None], positions, padding_mode="border", align_corners=False
            )[0, :, 0].mT
            total = total.index_add(0, samples, weight[samples, None] * values)
    return total


def _difference(
    values: Float[Tensor, "patch height width 2"], dim: int
) -> Float[Tensor, "patch height width 2"]:
    """Return forward differences, the last one repeated; zero along a single sample."""
    steps = values.diff(dim=dim)
    if steps.shape[dim] == 0:
        return torch.zeros_like(values)
    return torch.cat([steps, steps.narrow(dim, steps.shape[dim] - 1, 1)], dim=dim)


# Number of pyramid levels, the coarsest at an eighth of the photographs' size: templates of the
# coarsest scale have a sample for every four pixels. A choice.
LEVELS = 4


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Pyramid(Record):
    """Image pyramids, each level half the size of the previous one.

    The finest level is separate, so that it can be the photographs without a copy.

    Attributes:
        finest: Floating point, or fractions in 255ths.
        coarser: All other levels, concatenated, each of ``channel height width``.
        sizes: Height and width of every level, the finest first.
    """

    finest: Float[Tensor, "view channel height width"] | UInt8[Tensor, "view channel height width"]
    coarser: Float[Tensor, "view entry"] | UInt8[Tensor, "view entry"]
    sizes: tuple[tuple[int, int], ...]

    def levels(
        self, view: int
    ) -> list[Float[Tensor, "channel _ _"] | UInt8[Tensor, "channel _ _"]]:
        """Return a view's levels, the finest first."""
        channels = self.finest.shape[1]
        areas = [channels * height * width for height, width in self.sizes[1:]]
        coarser = zip(torch.split(self.coarser[view], areas), self.sizes[1:], strict=True)
        return [self.finest[view], *(level.reshape(channels, *size) for level, size in coarser)]

    @property
    def pictures(self) -> PictureRows:
        """The levels as arguments of kernels."""
        return PictureRows(as_array(self.finest.flatten(1)), as_array(self.coarser))

    @property
    def fractions(self) -> FractionRows:
        """Levels of fractions as arguments of kernels."""
        return FractionRows(as_array(self.finest.flatten(1)), as_array(self.coarser))

    @property
    def table(self) -> Int[Tensor, "level 3"]:
        """Height and width of every level, and its start in a channel of ``coarser``."""
        areas = torch.tensor([0, 0, *(height * width for height, width in self.sizes[1:])])
        sizes = torch.tensor(self.sizes)
        return torch.cat([sizes, areas.cumsum(0)[: len(sizes), None]], dim=1)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Sources(Record):
    """Pyramids of the photographs and of their priors. Excluded from hashes of the photographs.

    Attributes:
        images: Linear radiance; zero where it is not finite.
        unusable: Unusable fraction of every pixel, in 255ths: outside the undistorted frame or the
            mask, not finite, or saturated in any channel.
        gray: Mean over the channels.
        priors: Pyramids of the prior maps.
        lights: Prior lights, one a view, with infinite variance for views without one.
    """

    images: Pyramid = field(compare=False)
    unusable: Pyramid = field(compare=False)
    gray: Pyramid = field(compare=False)
    priors: "tuple[PriorMaps, ...]" = field(default=(), compare=False)
    lights: LightPrior | None = field(default=None, compare=False)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PriorMaps(Record):
    """Pyramids of the maps of one prior.

    Attributes:
        view: View of each map.
        zoom: Width and height of each map over those of its photograph.
        sizes_px: Width and height of each map.
        kind: Of the prior.
        maps: Values times their inverse variance, and the inverse variance; or probabilities.
        in_world: Whether normals are in the world frame, not the camera frame.
    """

    view: Int[Tensor, " map"]
    zoom: Float[Tensor, "map 2"]
    sizes_px: Int[Tensor, "map 2"]
    kind: Literal["normals", "depth", "albedo", "inlier"]
    maps: Sources
    in_world: bool = False

    def of(self, views: Int[Tensor, " view"]) -> "tuple[PriorMaps, Int[Tensor, ' row']]":
        """Return the maps of given views, renumbered to these, and their rows in ``maps``."""
        row, view = (self.view[:, None] == views).nonzero(as_tuple=True)
        return self.take(row).replace(view=view), row

    def cameras(self, cameras: Cameras) -> Cameras:
        """Return the pinhole cameras of the maps."""
        views = cameras.take(self.view)
        zoom = torch.cat([self.zoom, torch.ones_like(self.zoom[:, :1])], dim=1)
        intrinsics = zoom.to(views.intrinsics)[:, :, None] * views.intrinsics
        return views.replace(intrinsics=intrinsics, sizes_px=self.sizes_px)


def image_from_patch(
    cameras: Cameras, patch_from_world: Float[Tensor, "patch 4 4"]
) -> Float[Tensor, "patch view 3 4"]:
    """Return the projection matrices from patch frames to views, in float64; differentiable."""
    exact = cameras.to(torch.float64)
    # The last row is a constant, not a parameter.
    intrinsics = torch.cat([exact.intrinsics[:, :2], exact.intrinsics[:, 2:].detach()], dim=1)
    image_from_world = intrinsics @ exact.cam_from_world[:, :3]
    return image_from_world @ invert_rigid(patch_from_world.double())[:, None]


def centers_in_patches(
    cameras: Cameras, patch_from_world: Float[Tensor, "patch 4 4"]
) -> Float[Tensor, "patch view 3"]:
    """Return camera centres in patch frames, in float64; differentiable."""
    return transform(patch_from_world.double(), cameras.to(torch.float64).centers_world)


def kernel_geometry(
    rows: Int[Tensor, " view"],
    templates: Templates,
    outward: PatchVectors,
    projections: Float[Tensor, "patch view 3 4"],
    centers: Float[Tensor, "patch view 3"],
) -> tuple[Projection, Samples]:
    """Return cameras and samples as arguments of kernels, which compute pixels in float64.

    Args:
        rows: Index of each camera's photograph among the sources.
        outward: Unit normals of the samples, patch frame.
        projections: See :func:`image_from_patch`.
        centers: See :func:`centers_in_patches`.
    """
    projection = Projection(
        as_array(rows), as_array(projections.flatten(0, 1)), as_array(centers.flatten(0, 1))
    )
    samples = Samples(
        as_array(templates.origin, torch.float64),
        as_array(templates.spacing, torch.float64),
        as_array(templates.depth, torch.float32),
        as_array(outward, torch.float32),
    )
    return projection, samples


def build_pyramids(
    views: Views, saturation_level: float = SATURATED, levels: int = LEVELS
) -> Sources:
    """Build the pyramids of all photographs, once for all scales of a run.

    Differentiable in the photographs.

    Args:
        saturation_level: Radiance at or above which a pixel is unusable.
        levels: Maximum number; small photographs have fewer.
    """
    images = views.images
    if not all(bool(image.isfinite().all()) for (image,) in each(images)):
        # NaN times a weight of 0 is NaN; these pixels are marked as unusable below.
        images = by_view(lambda image: torch.where(image.isfinite(), image, 0), images)
    count, _, height, width = images.shape
    shapes = [(height, width)]
    while len(shapes) < levels and min(shapes[-1]) >= 8:
        shapes.append((shapes[-1][0] // 2, shapes[-1][1] // 2))
    sizes = tuple(shapes)

    def of_view(view: int) -> tuple[Tensor, ...]:
        image, original = images[view][None], views.images[view]
        wide, high = views.sizes_px[view].tolist()
        unusable = ~original.isfinite().all(dim=0) | (original.amax(dim=0) >= saturation_level)
        unusable[high:], unusable[:, wide:] = True, True
        if views.masks is not None:
            unusable = unusable | ~views.masks[view]
        coloured, fractions = [image], [unusable[None, None].to(image)]
        for _ in sizes[1:]:
            coloured.append(halve(coloured[-1]))
            fractions.append(halve(fractions[-1]))
        gray = [level[0].mean(dim=0) for level in coloured]

        def row(levels: list[Tensor]) -> Tensor:
            return torch.cat([level.reshape(-1) for level in levels[1:]] or [image.new_empty(0)])

        in_255ths = (255 * row(fractions)).round().to(torch.uint8)
        finest = 255 * unusable[None].to(torch.uint8)
        return row(coloured), gray[0][None], row(gray), finest, in_255ths

    per_view = side_by_side(of_view, range(count), tracked=False)
    first = next(per_view)
    stacked = tuple(zeros((count, *layer.shape), layer.dtype, layer.device) for layer in first)
    for view, layers in enumerate(chain([first], per_view)):
        for stack, layer in zip(stacked, layers, strict=True):
            stack[view] = layer
    halved, gray, halved_gray, unusable, halved_unusable = stacked
    return Sources(
        images=Pyramid(finest=images, coarser=halved, sizes=sizes),
        gray=Pyramid(finest=gray, coarser=halved_gray, sizes=sizes),
        unusable=Pyramid(finest=unusable, coarser=halved_unusable, sizes=sizes),
        priors=tuple(
            _prior_maps(prior, views, levels)
            for prior in views.priors
            if isinstance(prior, NormalPrior | DepthPrior | AlbedoPrior | InlierPrior)
            and set(prior.names) & set(views.names)
        ),
        lights=_lights_of(views),
    )


def _prior_maps(
    prior: NormalPrior | DepthPrior | AlbedoPrior | InlierPrior, views: Views, levels: int
) -> PriorMaps:
    """Build the pyramids of a prior's maps that belong to the views.

    Raises:
        InputError: Depth that is not along the camera's axis in scene units.
    """
    prior = prior.take([index for index, name in enumerate(prior.names) if name in views.names])
    view = torch.tensor([views.names.index(name) for name in prior.names], dtype=torch.long)
    kind: Literal["normals", "depth", "albedo", "inlier"]
    if isinstance(prior, InlierPrior):
        kind, values = "inlier", prior.probability[:, None]
        valid = torch.ones_like(prior.probability, dtype=torch.bool)
    else:
        valid = prior.variance.isfinite()
        precision = torch.where(valid, 1 / prior.variance, 0)[:, None]
        if isinstance(prior, NormalPrior):
            kind, layers = "normals", prior.normals.movedim(-1, 1)
        elif isinstance(prior, AlbedoPrior):
            kind, gray = "albedo", torch.where(valid, prior.albedo.mean(dim=1), torch.nan)
            layers = gray[:, None] / gray.flatten(1).nanmedian(dim=1).values[:, None, None, None]
            precision = precision * torch.where(valid, gray, 0).square()[:, None]
        else:
            if prior.inverse or prior.along != "axis" or prior.gauge != "scene":
                raise InputError(
                    "a DepthPrior is not in scene units along the camera's axis. Convert it with "
                    "`pimper_torch.priors.conventions`, which fits it to the cloud."
                )
            kind, layers = "depth", prior.depth[:, None]
        layers = torch.where(valid[:, None], layers, 0)
        values = torch.cat([precision * layers, precision], dim=1)
    as_views = Views(
        images=values.to(views.images),
        sizes_px=prior.sizes_px,
        names=prior.names,
        masks=valid,
        focals_px=torch.full_like(prior.sizes_px[:, 0], torch.nan, dtype=views.images.dtype),
    )
    return PriorMaps(
        view=view.to(prior.sizes_px.device),
        zoom=prior.sizes_px / views.sizes_px[view],
        sizes_px=prior.sizes_px,
        kind=kind,
        maps=build_pyramids(as_views, math.inf, levels),
        in_world=isinstance(prior, NormalPrior) and prior.frame == "world",
    )


def _lights_of(views: Views) -> LightPrior | None:
    prior = next((other for other in views.priors if isinstance(other, LightPrior)), None)
    if prior is None:
        return None
    lights = prior.lights.new_zeros(views.num_views, 4)
    variance = torch.full_like(lights[:, 0], torch.inf)
    for light, light_variance, name in zip(prior.lights, prior.variance, prior.names, strict=True):
        if name in views.names:
            view = views.names.index(name)
            lights[view], variance[view] = light, light_variance
    return prior.replace(lights=lights, variance=variance, names=views.names)
