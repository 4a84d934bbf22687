"""Agreement of every view with the texture of known backgrounds (plane and parallax).

A background is visible through homographies: the supporting plane, or a static background in front
of which the object turns. All photographs are rectified to it. Their median is its texture without
the things in front of it, and without shadows, which move with the light. Where a view agrees with
the texture it shows the background; elsewhere something is in front of it, textured or not.

Source: Irani & Anandan, PAMI 20(6), 1998, for plane and parallax.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.opencv import area_resized, warped, window_means
from pimper_torch.geometry.pixels import pixel_centers, scale_intrinsics
from pimper_torch.geometry.supporting_plane import Fixation, Plane
from pimper_torch.radiometry.response import srgb_from_linear
from pimper_torch.records import Cameras, Record, Views
from pimper_torch.records.shapes import Map, Maps, Mask, Masks, Matrix3
from pimper_torch.runtime.mapped import by_view, stacked, zeros
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.stages.silhouettes.image_shifts import shift_between

Homographies = Float[Tensor, "view 3 3"]
_FAINT = 0.03  # of white; ratios of darker colours are noise
RATIO = 100.0  # grey levels for a ratio of e


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class WorkingPictures(Record):
    """Photographs in display colours at the working size.

    Attributes:
        colours: Encoded as sRGB, with equal exposure; padding is black.
        opponent: Brightness and two colour ratios, which shadows change little.
        grey: Logarithm of the mean radiance.
        factors: Size of these images over that of the photographs, across and down.
    """

    colours: UInt8[Tensor, "view height width 3"]
    opponent: UInt8[Tensor, "view height width 3"]
    grey: Maps
    cameras: Cameras
    factors: tuple[float, float]


def working_pictures(views: Views, cameras: Cameras, size_px: int) -> WorkingPictures:
    """Shrink photographs so that the raster's longer side is at most ``size_px``."""
    height, width = views.images.shape[-2:]
    factor = min(1.0, size_px / max(height, width))
    wide, high = max(1, round(factor * width)), max(1, round(factor * height))
    factors = (wide / width, high / height)

    def layers_of(image: Float[Tensor, "channel _ _"]) -> tuple[Tensor, Tensor, Tensor]:
        small = area_resized(image, wide, high)
        white = torch.quantile(small.mean(dim=0).flatten()[::7], 0.99).clamp_min(1e-6)
        radiance = (small / white).clamp(0, 1).expand(3, -1, -1)
        colours = (255 * srgb_from_linear(radiance)).round().byte().permute(1, 2, 0)
        red, green, blue = torch.log(radiance + _FAINT)
        luma = 255 * srgb_from_linear(radiance.mean(dim=0))
        ratios = [128 + RATIO * (red - green), 128 + RATIO * (blue - green)]
        opponent = torch.stack([luma, *ratios], dim=-1).clamp(0, 255).round().byte()
        # Logarithms of darker values are noise.
        return colours, opponent, torch.log(small.mean(dim=0) / white + 0.005)

    images = views.images.detach().cpu().unbind()
    colours, opponent = (zeros((len(images), high, wide, 3), torch.uint8) for _ in range(2))
    grey = zeros((len(images), high, wide))
    for view, layers in enumerate(side_by_side(layers_of, images, tracked=False)):
        colours[view], opponent[view], grey[view] = layers
    scale = torch.tensor(factors)
    return WorkingPictures(
        colours=colours,
        opponent=opponent,
        grey=grey,
        cameras=cameras.to("cpu", torch.float32).replace(
            intrinsics=scale_intrinsics(cameras.intrinsics.cpu().float(), *factors),
            sizes_px=(cameras.sizes_px.cpu() * scale).round().long().clamp_min(1),
        ),
        factors=factors,
    )


def of_views(work: Callable[[int], Tensor], count: int) -> Tensor:
    """Stack the results of independent work on every view."""
    return stacked(side_by_side(work, range(count)), count)


# A background is static if shifted photographs correlate with one of them by more than the first,
# and agree with it by more than the second on more than the third of the background, in the median.
# A turntable: 0.26 and 0.58 of the background; arcs and orbits: at most 0.5 and 0.05.
_ALIKE, _SHOWN, _AT_REST = 0.2, 0.75, 0.25

DISPUTED = 0.5  # agreement where views disagree about the texture of the background
# Fractions of the images' longer side.
_WINDOW = 1 / 80  # side of the compared windows: 9 px of 640
_SHADING = 1 / 25  # smoother variation is light, not texture
# A window with a smaller standard deviation of log radiance is flat: a sensor has 0.01 of noise.
_FLAT = 0.008
_REACH = 1.0  # of the cameras' distance: half the side of the rectified plane
_STEP = 2.0  # working pixels at the fixation point between samples of the plane
# The same two for brightness, where there is no texture.
_FAR_REACH, _FAR_STEP = 2.0, 8.0
_NO_SHADOW = 3.0  # of log radiance, a factor of 20: light changes less on a plane


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Raster(Record):
    """A raster on a background.

    Attributes:
        pixels_from_raster: Homographies from the raster's pixels to those of each view; NaN for a
            view that does not see the background.
    """

    pixels_from_raster: Homographies
    size_px: tuple[int, int]


def plane_agreement(
    pictures: WorkingPictures, plane: Plane, fixation: Fixation, hidden: Masks | None = None
) -> Maps:
    """Return the agreement of each view with a plane's texture; see :func:`texture_agreement`.

    Args:
        fixation: The raster is centred at the foot of its fixation point.
        hidden: Pixels that are known not to show the plane.
    """
    near = plane_raster(pictures.cameras, plane, fixation, _REACH, _STEP)
    far = plane_raster(pictures.cameras, plane, fixation, _FAR_REACH, _FAR_STEP)
    return texture_agreement(pictures, near, far, hidden)


def background_agreement(
    pictures: WorkingPictures, background_from_view: Homographies, hidden: Masks | None = None
) -> Maps:
    """Return the agreement of each view with a static background; see :func:`texture_agreement`.

    The raster covers the views, in working pixels of the frame in which the background is static.

    Args:
        background_from_view: From pixels of each photograph to the frame in which the background is
            static; NaN for views that show too little of it.
        hidden: Pixels that are known not to show the background.
    """
    height, width = pictures.grey.shape[1:]
    scale = torch.diag(torch.tensor([*pictures.factors, 1.0]).double())
    maps = scale @ background_from_view.cpu().double() @ torch.linalg.inv(scale)
    corners = maps.new_tensor([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]])
    ends = (maps @ corners.mT).mT.reshape(-1, 3)
    ends = (ends[:, :2] / ends[:, 2:])[ends.isfinite().all(dim=1)]
    size = maps.new_tensor([width, height])
    # Shifts beyond the image's size are ignored.
    low = torch.maximum(ends.amin(dim=0), -size).floor()
    high = torch.minimum(ends.amax(dim=0), 2 * size).ceil()
    shift = torch.eye(3).to(maps)
    shift[:2, 2] = low
    to_pixels = torch.full_like(maps, torch.nan)
    mapped = maps.isfinite().flatten(1).all(dim=1)
    to_pixels[mapped] = torch.linalg.inv(maps[mapped]) @ shift
    columns, rows = (high - low).int().tolist()
    raster = Raster(pixels_from_raster=to_pixels.to(pictures.grey), size_px=(columns, rows))
    return texture_agreement(pictures, raster, raster, hidden)


def static_background_maps(
    pictures: WorkingPictures, surrounded: Masks
) -> Float[Tensor, "mapped 3 3"]:
    """Estimate maps to the static background of a turned object, even if the camera shifted.

    Args:
        surrounded: Pixels that the object's points surround.

    Returns:
        Maps for :func:`background_agreement`; empty if the photographs do not agree.
    """
    longer, nowhere = max(pictures.grey.shape[1:]), torch.zeros_like(surrounded[0])
    textures = by_view(
        lambda grey, inside: _textured(grey, nowhere, longer).masked_fill(inside, 0),
        pictures.grey,
        surrounded,
    )
    axes = pictures.cameras.cam_from_world[:, 2, :3]
    middle = int((axes @ axes.mT).sum(dim=1).argmax())
    shifts = [shift_between(texture, textures[middle]) for texture in textures]
    maps = torch.eye(3).double().repeat(len(shifts), 1, 1)
    maps[:, :2, 2] = torch.stack([shift for shift, _ in shifts]) / torch.tensor(pictures.factors)
    if torch.stack([correlation for _, correlation in shifts]).median() > _ALIKE:
        agrees = (background_agreement(pictures, maps) > _SHOWN) & ~surrounded
        if (agrees.sum(dim=(1, 2)) / (~surrounded).sum(dim=(1, 2))).median() > _AT_REST:
            return maps
    return maps[:0]


def texture_agreement(
    pictures: WorkingPictures, near: Raster, far: Raster, hidden: Masks | None = None
) -> Maps:
    r"""Return the agreement of each view with the texture of a background.

    Agreement in a window is :math:`2\,\mathrm{cov} / (\mathrm{var} + \mathrm{var}')` of log
    radiance without its smooth part.

    Args:
        far: Samples of the brightness, which may be fewer and extend farther.
        hidden: Pixels that are known not to show the background. They are compared with its
            texture, but do not contribute to it.

    Returns:
        Between -1 and 1; ``DISPUTED`` where views disagree about the background, such as where it
        is always hidden; NaN where it is flat, or few views see it; -1 where a view that does not
        agree is brighter or darker than the others by more than light explains.
    """
    count, longer = len(pictures.grey), max(pictures.grey.shape[1:])
    hidden = torch.zeros_like(pictures.grey, dtype=torch.bool) if hidden is None else hidden

    def textured(view: int) -> Map:
        return _textured(pictures.grey[view], hidden[view], longer)

    texture = of_views(textured, count)
    common, spread = _common(texture, hidden, near)
    brightness, brightness_spread = _common(pictures.grey, hidden, far)

    def agreement_of(view: int) -> Map:
        agreement = _agreement(texture[view], common[view], spread[view], longer)
        implausible = (pictures.grey[view] - brightness[view]).abs() > _NO_SHADOW
        implausible &= brightness_spread[view] < _NO_SHADOW / 2
        return torch.where(~(agreement > DISPUTED) & implausible, -1, agreement)

    return of_views(agreement_of, count)


def _common(values: Maps, hidden: Masks, raster: Raster) -> tuple[Maps, Maps]:
    """Return the views' median on a background, and its spread, warped back to each view."""
    maps, size_px = raster.pixels_from_raster, (values.shape[2], values.shape[1])
    sees = maps.isfinite().flatten(1).all(dim=1).tolist()

    def rectified(view: int) -> Float[Tensor, "row column"]:
        if not sees[view]:
            return values.new_full(raster.size_px[::-1], torch.nan)
        visible = values[view].masked_fill(hidden[view], torch.nan)
        return warped(visible, maps[view], raster.size_px)

    stack = of_views(rectified, len(values))
    rows = torch.split(stack, max(1, 2**20 // (len(stack) * raster.size_px[0])), dim=1)
    common, spread = torch.cat(list(side_by_side(_centre, rows, tracked=False)), dim=1)

    def back(view: int) -> Float[Tensor, "layer height width"]:
        if not sees[view]:
            return values.new_full((2, *size_px[::-1]), torch.nan)
        to = torch.linalg.inv(maps[view])
        return torch.stack([in_front(warped(x, to, size_px), to) for x in (common, spread)])

    common, spread = of_views(back, len(values)).unbind(dim=1)
    return common, spread


def _centre(values: Float[Tensor, "view row column"]) -> Float[Tensor, "2 row column"]:
    """Return the views' median and the spread around it; NaN where too few see the background."""
    common = values.nanmedian(dim=0).values
    spread = (values - common).abs().nanmedian(dim=0).values
    too_few = values.isfinite().sum(dim=0) < 3
    return torch.stack([common, spread]).masked_fill(too_few, torch.nan)


def in_front(layer: Map, raster_from_pixels: Matrix3) -> Map:
    """Set pixels to NaN that the homography maps to points behind the camera."""
    height, width = layer.shape
    pixels = pixel_centers(width, height, like=layer)
    scale = pixels @ raster_from_pixels[2, :2] + raster_from_pixels[2, 2]
    return torch.where(scale > 0, layer, torch.nan)


def plane_raster(
    cameras: Cameras, plane: Plane, fixation: Fixation, reach: float, step_px: float
) -> Raster:
    """Return a raster on the plane, centred at the foot of the fixation point."""
    normal = plane.normal_world
    axis = torch.eye(3)[normal.abs().argmin()].to(normal)
    first = normalize(torch.linalg.cross(normal, axis), dim=0)
    second = torch.linalg.cross(normal, first)
    foot = fixation.fixation_world - plane.height_of(fixation.fixation_world) * normal
    step = step_px * fixation.distance / cameras.intrinsics[:, 0, 0].median()
    size = int(2 * reach * fixation.distance / step)
    corner = foot - step * size / 2 * (first + second)
    world_from_raster = torch.stack([step * first, step * second, corner], dim=1)
    cam_from_raster = cameras.cam_from_world[:, :3, :3] @ world_from_raster
    cam_from_raster[:, :, 2] += cameras.cam_from_world[:, :3, 3]
    return Raster(pixels_from_raster=cameras.intrinsics @ cam_from_raster, size_px=(size, size))


def _textured(grey: Map, hidden: Mask, longer: int) -> Map:
    """Subtract the light: the smooth part, on the background and on hidden pixels separately."""
    window = _odd(_SHADING * longer)
    off = hidden.to(grey)
    sums = window_means(torch.stack([grey * off, off, grey * (1 - off), 1 - off]), window)
    smooth = torch.where(hidden, sums[0] / sums[1], sums[2] / sums[3])
    return grey - smooth


def _agreement(view: Map, common: Map, spread: Map, longer: int) -> Map:
    valid = common.isfinite() & spread.isfinite()
    common, spread = torch.where(valid, common, 0), torch.where(valid, spread, 0)
    layers = [view, common, view * view, common * common, view * common, spread, valid.to(view)]
    means = window_means(torch.stack(layers), _odd(_WINDOW * longer))
    variance = (means[2] - means[0] ** 2).clamp_min(0)
    variance_common = (means[3] - means[1] ** 2).clamp_min(0)
    agreement = 2 * (means[4] - means[0] * means[1]) / (variance + variance_common)
    disputed = means[5] > variance_common.sqrt().clamp_min(_FLAT)
    comparable = (torch.maximum(variance, variance_common) > _FLAT**2) & (means[6] > 0.999)
    return torch.where(comparable, torch.where(disputed, DISPUTED, agreement), torch.nan)


def _odd(size: float) -> int:
    return 2 * round(size / 2) + 1
