r"""Points found again in photographs, to a small fraction of a pixel, whatever the light.

What a view shows round a point is the reference view's patch, moved along the plane by a few
numbers. Of the logarithm of the radiance, light that changes from view to view adds a constant
and, over a patch, about a slope; both are projected out of patch and template alike, a common
factor (contrast) is fitted. What remains is aligned by Gauss-Newton on the template's slopes,
which are computed once for all views (inverse compositional).

Source: Baker & Matthews, Lucas-Kanade 20 years on, IJCV 2004; that points of structure from motion
deserve it, Lindenberger et al., Pixel-perfect structure-from-motion, ICCV 2021, with learned
features in the place of the logarithm.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from torch.nn.functional import grid_sample, pad

from pimper_torch.geometry.pixels import grid_from_pixels
from pimper_torch.mapped import drop_pages, zeros
from pimper_torch.parallel import side_by_side
from pimper_torch.radiometry import SATURATED
from pimper_torch.records import Cameras, Record
from pimper_torch.sfm.tangent_planes import Tangents, plane_homographies

# Fraction of the median radiance below which the logarithm fades: darker is noise.
_DARK = 0.02

# Pixels from one to the next of those whose median is taken.
_MEDIAN_STRIDE = 4

_ITERATIONS = 10

# Curvature of a template's match along its worst direction over that along its best, at least:
# below, it is a stripe, and noise tells its place.
_MIN_ROUNDNESS = 0.01

# Steps of the plane, about pixels of the reference: the longest at once; the one that ends.
_LONGEST_STEP, _CONVERGED = 1.5, 0.02

# After so many iterations a patch that is nowhere near is given up.
_TRIAL, _HOPELESS = 4, 0.4

# Bounds of the contrast against the template's.
_CONTRAST = (0.3, 3.0)

# Fraction of a patch that a view may lack: padding, masked, saturated.
_MAX_LACKING = 0.1

_AT_ONCE = 4096

# Points whose templates are in memory together: 115 MB of them, several times while they are made.
_TEMPLATES = 2**15


@dataclass(frozen=True, slots=True, kw_only=True)
class SightingSettings:
    """When a point counts as found.

    Attributes:
        radius_px: Half the side of the patch.
        min_correlation: With the template, light taken out.
        max_shift_px: From where the cameras put the point.
        max_deviation_px: Standard deviation of the place along its worst direction.
    """

    radius_px: int = 8
    min_correlation: float = 0.8
    max_shift_px: float = 3.0
    max_deviation_px: float = 0.5


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class LogPictures(Record):
    """Photographs in which patches are looked up.

    Attributes:
        unusable: 1 where a pixel cannot be used.
    """

    log: Float[Tensor, "view height width"]
    unusable: UInt8[Tensor, "view height width"]


def log_pictures(
    photographs: Iterable[tuple[Float[Tensor, "_ _ _"], Bool[Tensor, "_ _"]]],
    raster: tuple[int, int, int],
) -> LogPictures:
    """Take logarithms of photographs one by one, so that no others are held.

    Args:
        photographs: Radiance, channels first, and where it is valid; of any sizes.
        raster: How many there are, and the height and width that they are padded to.

    Returns:
        On the CPU, float32, a constant to autograd. Pixels that are padding, invalid, not finite
        or saturated in one channel are unusable.
    """
    log, unusable = zeros(raster), zeros(raster, torch.uint8).fill_(1)
    for index, (image, valid) in enumerate(photographs):
        height, width = valid.shape
        radiance = image.detach()
        usable = valid & radiance.isfinite().all(dim=0) & (radiance.amax(dim=0) < SATURATED)
        log[index, :height, :width] = torch.where(usable, radiance.mean(dim=0), 0)
        unusable[index, :height, :width] = ~usable
        drop_pages()
    some = log[:, ::_MEDIAN_STRIDE, ::_MEDIAN_STRIDE]
    some = some[some > 0]
    floor = _DARK * some.median() if len(some) else torch.ones(())
    return LogPictures(log=log.add_(floor.clamp_min(1e-6)).log_(), unusable=unusable)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class TrackObservations(Record):
    """Where views show points.

    Attributes:
        pixels: Where, in the undistorted photograph.
    """

    point: Int[Tensor, " sighting"]
    view: Int[Tensor, " sighting"]
    pixels: Float[Tensor, "sighting 2"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Templates(Record):
    """Patches as the reference views show them.

    Attributes:
        values: Light taken out; the window's square root is in them.
        usable: True where the reference shows nearly all of the patch, with texture.
    """

    values: Float[Tensor, "point sample"]
    slopes: Float[Tensor, "point sample 2"]
    inverse: Float[Tensor, "point 2 2"]
    usable: Bool[Tensor, " point"]


class _Window:
    """The raster of a patch in steps of the plane, its weights, and what light may change."""

    def __init__(self, radius: int, like: Tensor) -> None:
        side = torch.arange(-radius, radius + 1).to(like)
        v, u = torch.meshgrid(side, side, indexing="ij")
        self.side = 2 * radius + 1
        self.places = torch.stack([u.flatten(), v.flatten(), torch.ones_like(u).flatten()])
        weight = torch.exp(-(u.square() + v.square()).flatten() * 1.5 / radius**2)
        self.root, self.total = weight.sqrt(), float(weight.sum())
        light = (self.places * self.root).mT
        self.light = torch.linalg.qr(light).Q

    def freed(self, patches: Float[Tensor, "*batch sample"]) -> Float[Tensor, "*batch sample"]:
        """Weigh patches, and project constant and slope out."""
        heavy = patches * self.root
        return heavy - heavy @ self.light @ self.light.mT


def sight(
    pictures: LogPictures, cameras: Cameras, tangents: Tangents, settings: SightingSettings
) -> TrackObservations:
    """Find points in all views that may show them.

    A point's place in its reference view is where the cameras put it: there the template is
    taken. In the other views it is where the same patch is found.

    Returns:
        Sorted by point, then view; the reference's own is there where another view found
        the point. A constant to autograd.
    """
    found = []
    for first in range(0, max(len(tangents.points_world), 1), _TEMPLATES):
        some = _sight(pictures, cameras, tangents.take(slice(first, first + _TEMPLATES)), settings)
        found.append(some.replace(point=some.point + first))
    return TrackObservations.cat(found)


def _sight(
    pictures: LogPictures, cameras: Cameras, tangents: Tangents, settings: SightingSettings
) -> TrackObservations:
    """Find so many points that their templates fit in memory."""
    with torch.no_grad():
        window = _Window(settings.radius_px, like=pictures.log)
        templates = _templates(pictures, cameras, tangents, window)

        def in_view(view: int) -> tuple[Tensor, Tensor, Tensor]:
            (some,) = torch.nonzero(tangents.candidates[:, view] & templates.usable, as_tuple=True)
            found = [(some[:0], some[:0], tangents.points_world[:0, :2])]
            for chosen in torch.split(some, _AT_ONCE):
                homographies = plane_homographies(tangents, cameras, view, chosen)
                kept, pixels = _aligned(
                    pictures, view, homographies, chosen, templates, window, settings
                )
                shown = chosen[kept]
                found.append((shown, torch.full_like(shown, view), pixels[kept]))
            point, view_, pixels = (torch.cat(part) for part in zip(*found, strict=True))
            return point, view_, pixels

        parts = side_by_side(in_view, range(len(pictures.log)))
        point, view_, pixels = (torch.cat(part) for part in zip(*parts, strict=True))
        found = torch.zeros_like(templates.usable)
        found[point] = True
        (own,) = torch.nonzero(found, as_tuple=True)
        point = torch.cat([point, own])
        view_ = torch.cat([view_, tangents.reference[own]])
        pixels = torch.cat([pixels, _own(tangents, cameras)[own]])
        order = torch.argsort(point * len(pictures.log) + view_)
        return TrackObservations(point=point[order], view=view_[order], pixels=pixels[order])


def _templates(
    pictures: LogPictures,
    cameras: Cameras,
    tangents: Tangents,
    window: _Window,
) -> _Templates:
    count = len(tangents.points_world)
    patches = pictures.log.new_zeros(count, window.places.shape[1])
    whole = torch.zeros(count, dtype=torch.bool, device=pictures.log.device)
    for view in range(len(pictures.log)):
        (some,) = torch.nonzero(tangents.reference == view, as_tuple=True)
        if len(some) == 0:
            continue
        homographies = plane_homographies(tangents, cameras, view, some)
        patches[some] = _look_up(pictures.log[view], homographies, window)
        whole[some] = _complete(pictures.unusable[view], homographies, window)
    square = patches.reshape(count, window.side, window.side)
    down, right = torch.gradient(square, dim=(1, 2))
    slopes = torch.stack([window.freed(right.flatten(1)), window.freed(down.flatten(1))], dim=-1)
    normal = slopes.mT @ slopes
    worst, best = torch.linalg.eigvalsh(normal).unbind(dim=1)
    told = (best > 1e-9) & (worst > _MIN_ROUNDNESS * best)
    safe = torch.where(told[:, None, None], normal, torch.eye(2).to(normal))
    return _Templates(
        values=window.freed(patches),
        slopes=slopes,
        inverse=torch.linalg.inv(safe),
        usable=whole & told,
    )


def _aligned(
    pictures: LogPictures,
    view: int,
    homographies: Float[Tensor, "point 3 3"],
    chosen: Int[Tensor, " point"],
    templates: _Templates,
    window: _Window,
    settings: SightingSettings,
) -> tuple[Bool[Tensor, " point"], Float[Tensor, "point 2"]]:
    """Align one view's patches; return which were found, and their pixels."""
    from pimper_torch.kernels.patch_alignment import align

    limits = (_ITERATIONS, _LONGEST_STEP, _CONVERGED, _TRIAL, _HOPELESS, *_CONTRAST)
    shift = homographies.new_empty(len(homographies), 2)
    deviation, correlation = torch.empty_like(shift).mT.contiguous()
    align(
        pictures.log[view].numpy(),
        homographies.contiguous().numpy(),
        chosen.contiguous().numpy(),
        templates.values.contiguous().numpy(),
        templates.slopes.contiguous().numpy(),
        templates.inverse.contiguous().numpy(),
        window.places.contiguous().numpy(),
        window.root.contiguous().numpy(),
        window.light.contiguous().numpy(),
        np.array([*limits, settings.max_shift_px], dtype=np.float64),
        shift.numpy(),
        deviation.numpy(),
        correlation.numpy(),
    )
    arrived = shift.isfinite().all(dim=1)
    final = _shifted(homographies, torch.where(arrived[:, None], shift, 0))
    found = arrived & (correlation >= settings.min_correlation)
    found &= deviation <= settings.max_deviation_px
    found &= _complete(pictures.unusable[view], final, window)
    return found, final[:, :2, 2] / final[:, 2:, 2]


def _shifted(
    homographies: Float[Tensor, "point 3 3"], shift: Float[Tensor, "point 2"]
) -> Float[Tensor, "point 3 3"]:
    """Begin the plane's steps elsewhere."""
    centre = homographies[:, :, 2] + (homographies[:, :, :2] @ shift[..., None])[..., 0]
    return torch.cat([homographies[:, :, :2], centre[..., None]], dim=2)


def _own(tangents: Tangents, cameras: Cameras) -> Float[Tensor, "point 2"]:
    """Return the points' pixels in their reference views."""
    frames = cameras.cam_from_world[tangents.reference]
    points = (frames[:, :3, :3] @ tangents.points_world[..., None])[..., 0] + frames[:, :3, 3]
    homogeneous = (cameras.intrinsics[tangents.reference] @ points[..., None])[..., 0]
    return homogeneous[:, :2] / homogeneous[:, 2:]


def _complete(
    unusable: UInt8[Tensor, "height width"],
    homographies: Float[Tensor, "point 3 3"],
    window: _Window,
) -> Bool[Tensor, " point"]:
    """Find whose patches a view shows nearly all of."""
    lacking = _look_up(unusable.float(), homographies, window, mode="nearest", outside=1.0)
    fraction = (lacking * window.root.square()).sum(dim=1) / window.total
    return fraction <= _MAX_LACKING


def _look_up(
    picture: Float[Tensor, "height width"],
    homographies: Float[Tensor, "point 3 3"],
    window: _Window,
    mode: str = "bilinear",
    outside: float | None = None,
) -> Float[Tensor, "point sample"]:
    """Look patches up: as many batches as threads, each is one thread's on the CPU.

    Bilinear: torch's cubic kernel displaces patches by a twentieth of a pixel, this by a hundredth.
    """
    height, width = picture.shape
    homogeneous = homographies @ window.places.to(homographies)
    ahead = homogeneous[:, 2] > 0
    pixels = homogeneous[:, :2] / torch.where(ahead, homogeneous[:, 2], torch.inf)[:, None]
    grid = grid_from_pixels(pixels.mT, width, height).to(picture)
    flat = grid.clamp(-3, 3).reshape(-1, 2)
    threads = torch.get_num_threads()
    filled = pad(flat, (0, 0, 0, -len(flat) % threads)).reshape(threads, 1, -1, 2)
    found = grid_sample(
        picture.expand(threads, 1, -1, -1),
        filled,
        mode=mode,
        padding_mode="border",
        align_corners=False,
    ).flatten()[: len(flat)]
    found = found.reshape(grid.shape[:-1])
    if outside is None:
        return found
    return torch.where((grid.abs() <= 1).all(dim=-1) & ahead, found, outside)
