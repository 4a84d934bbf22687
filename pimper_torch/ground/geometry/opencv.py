"""Operations of OpenCV on masks and photographs."""

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from pimper_torch.ground.shapes import Map, Mask, Matrix3, Pixels

BACKGROUND, OBJECT = cv2.GC_BGD, cv2.GC_FGD
PERHAPS_BACKGROUND, PERHAPS_OBJECT = cv2.GC_PR_BGD, cv2.GC_PR_FGD


def signed_distance(mask: Mask) -> Map:
    """Return each pixel's distance to the border of a mask in pixels, positive inside.

    The border runs midway between the centres of unlike neighbours. Where nothing is masked,
    or all is, the distance is minus or plus the sum of the sides.
    """
    drawn = mask.cpu().numpy().astype(np.uint8)
    far = float(sum(drawn.shape))
    if drawn.all() or not drawn.any():
        return torch.full(mask.shape, far if drawn.all() else -far, device=mask.device)
    inner, outer = (_exact_distance(side) for side in (drawn, 1 - drawn))
    signed = np.where(drawn > 0, inner - 0.5, 0.5 - outer)
    return torch.from_numpy(signed.astype(np.float32)).to(mask.device)


def _exact_distance(drawn: np.ndarray) -> np.ndarray:
    """Return each pixel's distance to the nearest zero.

    The last bit of OpenCV's depends on where in memory the pixels lie. Squares of distances
    between centres of pixels are whole numbers.
    """
    found = cv2.distanceTransform(drawn, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    exact: np.ndarray = np.sqrt(np.rint(np.square(found, dtype=np.float64)))
    return exact


def shrunk(
    image: Float[Tensor, "channel height width"], width: int, height: int
) -> Float[Tensor, "channel {height} {width}"]:
    """Average an image over the pixels of a smaller one."""
    pixels = image.movedim(0, -1).contiguous().numpy()
    small = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)
    return torch.from_numpy(small.reshape(height, width, -1)).movedim(-1, 0)


def warped(
    picture: Map, homography: Matrix3, size_px: tuple[int, int]
) -> Float[Tensor, "high wide"]:
    """Look up a picture through a homography, bilinearly; NaN beyond its border.

    Args:
        homography: From pixels of the result to those of ``picture``.
    """
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])  # OpenCV counts from centres
    matrix = np.linalg.inv(half) @ homography.double().numpy() @ half
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    found = cv2.warpPerspective(
        picture.numpy(), matrix, size_px, flags=flags, borderValue=float("nan")
    )
    return torch.from_numpy(found)


def window_means(
    maps: Float[Tensor, "map height width"], window: int
) -> Float[Tensor, "map height width"]:
    """Average over square windows, mirrored at the border."""
    pixels = maps.movedim(0, -1).contiguous().numpy()
    means = cv2.boxFilter(pixels, -1, (window, window)).reshape(pixels.shape)
    return torch.from_numpy(means).movedim(-1, 0)


def grab_cut_halved(
    colours: UInt8[Tensor, "height width 3"], labels: UInt8[Tensor, "height width"], iterations: int
) -> Mask:
    """Cut as :func:`grab_cut`, but every other pixel each way: right to two, in a quarter of it."""
    half = grab_cut(colours[::2, ::2], labels[::2, ::2], iterations)
    height, width = labels.shape
    return half.repeat_interleave(2, dim=0).repeat_interleave(2, dim=1)[:height, :width]


def grab_cut(
    colours: UInt8[Tensor, "height width 3"], labels: UInt8[Tensor, "height width"], iterations: int
) -> Mask:
    """Cut the object out by two mixtures of colours and a graph cut.

    Rother, Kolmogorov & Blake, GrabCut, SIGGRAPH 2004. Deterministic.

    Args:
        labels: ``BACKGROUND`` or ``OBJECT`` for certain, or ``PERHAPS_BACKGROUND`` or
            ``PERHAPS_OBJECT``; some of each side.
    """
    seeded = labels & 1 > 0
    if not seeded.any() or seeded.all():
        return seeded
    cv2.setRNGSeed(0)
    other = labels != BACKGROUND
    sides = (other.any(dim=1).nonzero(), other.any(dim=0).nonzero())
    window = tuple(slice(max(0, int(side[0]) - 8), int(side[-1]) + 9) for side in sides)
    drawn = labels[window].contiguous().numpy().copy()
    models = np.zeros((1, 65)), np.zeros((1, 65))
    pixels = colours[window].contiguous().numpy()
    cv2.grabCut(pixels, drawn, None, *models, iterations, cv2.GC_INIT_WITH_MASK)
    found = torch.zeros_like(seeded)
    found[window] = torch.from_numpy((drawn & 1) > 0)
    return found


def opened(mask: Mask, radius_px: int) -> Mask:
    """Leave out what no disc of that radius fits into."""
    return _morphed(mask, cv2.MORPH_OPEN, radius_px)


def closed(mask: Mask, radius_px: int) -> Mask:
    """Fill what no disc of that radius fits into."""
    return _morphed(mask, cv2.MORPH_CLOSE, radius_px)


def dilated(layer: Map, reach_px: int) -> Map:
    """Return the largest value of the square around each pixel that reaches so far."""
    return torch.from_numpy(cv2.dilate(layer.numpy(), np.ones((2 * reach_px + 1,) * 2)))


def convex_hull_of(pixels: Pixels, size_px: tuple[int, int]) -> Mask:
    """Fill the convex hull of pixels."""
    drawn = np.zeros(size_px[::-1], dtype=np.uint8)
    if len(pixels):
        hull = cv2.convexHull(pixels.numpy().astype(np.float32))
        cv2.fillConvexPoly(drawn, np.floor(hull).astype(np.int32), 1)
    return torch.from_numpy(drawn > 0)


def discs_at(pixels: Pixels, radius_px: float, size_px: tuple[int, int]) -> Mask:
    """Find what is within a distance of pixels."""
    drawn = np.ones(size_px[::-1], dtype=np.uint8)
    column, row = pixels.floor().long().T.numpy()
    inside = (column >= 0) & (row >= 0) & (column < size_px[0]) & (row < size_px[1])
    if not inside.any():
        return torch.zeros(size_px[::-1], dtype=torch.bool)
    drawn[row[inside], column[inside]] = 0
    return torch.from_numpy(cv2.distanceTransform(drawn, cv2.DIST_L2, 3) <= radius_px)


def _morphed(mask: Mask, how: int, radius_px: int) -> Mask:
    size = 2 * radius_px + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return torch.from_numpy(cv2.morphologyEx(mask.numpy().astype(np.uint8), how, disc) > 0)


def without_specks(mask: Mask, kept: Mask, min_px: int) -> Mask:
    """Drop components that are small or do not reach ``kept``, and fill small holes."""
    return ~_large(~_large(mask, kept, min_px), torch.ones_like(mask), min_px)


def components_of(mask: Mask, meeting: Mask) -> Mask:
    """Keep the components of a mask that reach ``meeting``."""
    return _large(mask, meeting, 1)


def _large(mask: Mask, meeting: Mask, min_px: int) -> Mask:
    drawn = mask.numpy().astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(drawn, connectivity=4)
    met = np.bincount(labels[meeting.numpy()], minlength=count) > 0
    taken = met & (stats[:, cv2.CC_STAT_AREA] >= min_px) & (np.arange(count) > 0)
    return torch.from_numpy(taken[labels])


def blind_holes(mask: Mask, seen_through: Mask, fraction: float) -> Mask:
    """Find the holes of a mask of which less than a fraction is seen through."""
    drawn = (~mask).numpy().astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(drawn, connectivity=4)
    through = np.bincount(labels[seen_through.numpy()], minlength=count)
    left, top = stats[:, cv2.CC_STAT_LEFT], stats[:, cv2.CC_STAT_TOP]
    right, bottom = left + stats[:, cv2.CC_STAT_WIDTH], top + stats[:, cv2.CC_STAT_HEIGHT]
    height, width = drawn.shape
    enclosed = (left > 0) & (top > 0) & (right < width) & (bottom < height)
    blind = enclosed & (through < fraction * stats[:, cv2.CC_STAT_AREA]) & (np.arange(count) > 0)
    return torch.from_numpy(blind[labels])
