"""OpenCV operations on masks and photographs."""

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from pimper_torch.records.shapes import Map, Mask, Matrix3, Pixels

BACKGROUND, OBJECT = cv2.GC_BGD, cv2.GC_FGD
PERHAPS_BACKGROUND, PERHAPS_OBJECT = cv2.GC_PR_BGD, cv2.GC_PR_FGD


def signed_distance(mask: Mask) -> Map:
    """Return the distance of each pixel to the border of a mask, in pixels, positive inside.

    The border is midway between the centres of neighbours that differ. For an empty mask the
    distance is minus the sum of the sides, for a full one plus.
    """
    pixels = mask.cpu().numpy().astype(np.uint8)
    far = float(sum(pixels.shape))
    if pixels.all() or not pixels.any():
        return torch.full(mask.shape, far if pixels.all() else -far, device=mask.device)
    inner, outer = (_exact_distance(side) for side in (pixels, 1 - pixels))
    signed = np.where(pixels > 0, inner - 0.5, 0.5 - outer)
    return torch.from_numpy(signed.astype(np.float32)).to(mask.device)


def _exact_distance(mask: np.ndarray) -> np.ndarray:
    """Return the distance of each pixel to the nearest zero.

    The last bit of OpenCV's result depends on the memory address of the pixels. Squared distances
    between pixel centres are integers, so rounding them makes the result exact.
    """
    distance = cv2.distanceTransform(mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    exact: np.ndarray = np.sqrt(np.rint(np.square(distance, dtype=np.float64)))
    return exact


def area_resized(
    image: Float[Tensor, "channel height width"], width: int, height: int
) -> Float[Tensor, "channel {height} {width}"]:
    """Resize an image to a smaller one by area averaging."""
    pixels = image.movedim(0, -1).contiguous().numpy()
    small = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)
    return torch.from_numpy(small.reshape(height, width, -1)).movedim(-1, 0)


def warped(
    picture: Map, homography: Matrix3, size_px: tuple[int, int]
) -> Float[Tensor, "high wide"]:
    """Resample an image through a homography, bilinearly; NaN outside the image.

    Args:
        homography: From pixels of the result to those of ``picture``.
    """
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])  # OpenCV counts from pixel centres
    matrix = np.linalg.inv(half) @ homography.double().numpy() @ half
    flags, pixels, nan = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, picture.numpy(), float("nan")
    result = cv2.warpPerspective(pixels, matrix, size_px, flags=flags, borderValue=nan)
    return torch.from_numpy(result)


def window_means(
    maps: Float[Tensor, "map height width"], window: int
) -> Float[Tensor, "map height width"]:
    """Return the means of maps over square windows, mirrored at the border."""
    pixels = maps.movedim(0, -1).contiguous().numpy()
    means = cv2.boxFilter(pixels, -1, (window, window)).reshape(pixels.shape)
    return torch.from_numpy(means).movedim(-1, 0)


def grab_cut_halved(
    colours: UInt8[Tensor, "height width 3"], labels: UInt8[Tensor, "height width"], iterations: int
) -> Mask:
    """Segment as :func:`grab_cut` at half size: accurate to 2 pixels, in a quarter of the time."""
    half = grab_cut(colours[::2, ::2], labels[::2, ::2], iterations)
    height, width = labels.shape
    return half.repeat_interleave(2, dim=0).repeat_interleave(2, dim=1)[:height, :width]


def grab_cut(
    colours: UInt8[Tensor, "height width 3"], labels: UInt8[Tensor, "height width"], iterations: int
) -> Mask:
    """Segment the object by two colour mixtures and a graph cut; deterministic.

    Without initial pixels of both sides, the initial mask is returned. Source: Rother, Kolmogorov &
    Blake, GrabCut, SIGGRAPH 2004.

    Args:
        labels: ``BACKGROUND`` or ``OBJECT`` if fixed, else ``PERHAPS_BACKGROUND`` or
            ``PERHAPS_OBJECT``.
    """
    seeded = labels & 1 > 0
    if not seeded.any() or seeded.all():
        return seeded
    cv2.setRNGSeed(0)
    other = labels != BACKGROUND
    sides = (other.any(dim=1).nonzero(), other.any(dim=0).nonzero())
    window = tuple(slice(max(0, int(side[0]) - 8), int(side[-1]) + 9) for side in sides)
    cut_labels = labels[window].contiguous().numpy().copy()
    models = np.zeros((1, 65)), np.zeros((1, 65))
    pixels = colours[window].contiguous().numpy()
    cv2.grabCut(pixels, cut_labels, None, *models, iterations, cv2.GC_INIT_WITH_MASK)
    mask = torch.zeros_like(seeded)
    mask[window] = torch.from_numpy((cut_labels & 1) > 0)
    return mask


def opening(mask: Mask, radius_px: int) -> Mask:
    """Open a mask with a disc: remove parts narrower than the disc."""
    return _morphed(mask, cv2.MORPH_OPEN, radius_px)


def closing(mask: Mask, radius_px: int) -> Mask:
    """Close a mask with a disc: fill gaps narrower than the disc."""
    return _morphed(mask, cv2.MORPH_CLOSE, radius_px)


def dilation(layer: Map, reach_px: int) -> Map:
    """Return the maximum over the square of ``2 reach_px + 1`` pixels a side around each pixel."""
    return torch.from_numpy(cv2.dilate(layer.numpy(), np.ones((2 * reach_px + 1,) * 2)))


def convex_hull_of(pixels: Pixels, size_px: tuple[int, int]) -> Mask:
    """Return the mask of the convex hull of pixels."""
    mask = np.zeros(size_px[::-1], dtype=np.uint8)
    if len(pixels):
        hull = cv2.convexHull(pixels.numpy().astype(np.float32))
        cv2.fillConvexPoly(mask, np.floor(hull).astype(np.int32), 1)
    return torch.from_numpy(mask > 0)


def discs_at(pixels: Pixels, radius_px: float, size_px: tuple[int, int]) -> Mask:
    """Return the mask of all pixels within a distance of the given ones."""
    mask = np.ones(size_px[::-1], dtype=np.uint8)
    column, row = pixels.floor().long().T.numpy()
    inside = (column >= 0) & (row >= 0) & (column < size_px[0]) & (row < size_px[1])
    if not inside.any():
        return torch.zeros(size_px[::-1], dtype=torch.bool)
    mask[row[inside], column[inside]] = 0
    return torch.from_numpy(cv2.distanceTransform(mask, cv2.DIST_L2, 3) <= radius_px)


def _morphed(mask: Mask, operation: int, radius_px: int) -> Mask:
    size = 2 * radius_px + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return torch.from_numpy(cv2.morphologyEx(mask.numpy().astype(np.uint8), operation, disc) > 0)


def without_specks(mask: Mask, kept: Mask, min_px: int) -> Mask:
    """Remove components that are small or do not overlap ``kept``, and fill small holes."""
    large = components_of(mask, kept, min_px)
    return ~components_of(~large, torch.ones_like(mask), min_px)


def components_of(mask: Mask, meeting: Mask, min_px: int = 1) -> Mask:
    """Return the components of a mask that overlap ``meeting`` and are not smaller than a size."""
    pixels = mask.numpy().astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(pixels, connectivity=4)
    overlapping = np.bincount(labels[meeting.numpy()], minlength=count) > 0
    kept = overlapping & (stats[:, cv2.CC_STAT_AREA] >= min_px) & (np.arange(count) > 0)
    return torch.from_numpy(kept[labels])


def blind_holes(mask: Mask, seen_through: Mask, fraction: float) -> Mask:
    """Return the holes of a mask with less than ``fraction`` of their area seen through."""
    outside = (~mask).numpy().astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(outside, connectivity=4)
    through = np.bincount(labels[seen_through.numpy()], minlength=count)
    left, top = stats[:, cv2.CC_STAT_LEFT], stats[:, cv2.CC_STAT_TOP]
    right, bottom = left + stats[:, cv2.CC_STAT_WIDTH], top + stats[:, cv2.CC_STAT_HEIGHT]
    height, width = outside.shape
    enclosed = (left > 0) & (top > 0) & (right < width) & (bottom < height)
    blind = enclosed & (through < fraction * stats[:, cv2.CC_STAT_AREA]) & (np.arange(count) > 0)
    return torch.from_numpy(blind[labels])
