"""Choice of frames of a video: the sharpest ones, at equal distances along the way."""

from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from pimper_torch.runtime.errors import InputError

# Width of the pictures in which motion is measured. A choice: a hundredth of it is 3 pixels.
_WIDTH_PX = 320
# A frame is compared with one before until it has moved so far, fractions of the width: what noise
# adds then counts once. A choice, 6 pixels of 320: flow is still sure.
_STEP = 0.02
Thumbnail = UInt8[np.ndarray, "height width"]


class Scan(NamedTuple):
    """Sharpness of every frame of a video, and how far pictures have moved since the first."""

    sharpness: Float[Tensor, " frame"]
    way: Float[Tensor, " frame"]


def scanned(frames: Iterable[UInt8[Tensor, "height width"]]) -> Scan:
    """Measure every frame of a video, in order; the way is in widths of the frame."""
    sharp, way = list[float](), list[float]()
    anchor, walked = None, 0.0
    for luma in frames:
        small = thumbnail(luma)
        moved = 0.0 if anchor is None else motion(anchor, small)
        sharp.append(sharpness(luma))
        way.append(walked + moved)
        if anchor is None or moved > _STEP:
            anchor, walked = small, walked + moved
    return Scan(torch.tensor(sharp), torch.tensor(way).cummax(dim=0).values)


def sharpness(luma: UInt8[Tensor, "height width"]) -> float:
    """Find how much neighbours differ, as a fraction of what pixels a little apart differ.

    It is that of rows or of columns, whichever is less: motion blurs along one of them. Brightness
    and contrast cancel. It compares frames of one video; 0 where nothing differs.
    """
    finest = []
    for values in (luma.float(), luma.float().mT):
        near, far = (float((values[:, lag:] - values[:, :-lag]).square().mean()) for lag in (1, 4))
        finest.append(near / far if far > 0 else 0.0)
    return min(finest)


def thumbnail(luma: UInt8[Tensor, "height width"]) -> Thumbnail:
    """Shrink a frame to the size that motion is measured in."""
    height, width = luma.shape
    size = (_WIDTH_PX, max(16, round(height * _WIDTH_PX / width)))
    return cv2.resize(luma.numpy(), size, interpolation=cv2.INTER_AREA)


def motion(before: Thumbnail, after: Thumbnail) -> float:
    """Measure the largest motion between thumbnails, as a fraction of their width.

    Source: Kroeger, Timofte, Dai, Van Gool, Fast optical flow using dense inverse search,
    ECCV 2016, for the flow.
    """
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST).calc(before, after, None)
    # An object that turns in front of a wall covers a fifth.
    return float(np.quantile(np.linalg.norm(flow, axis=2), 0.8)) / before.shape[1]


def chosen(scan: Scan, count: int) -> Int[Tensor, " chosen"]:
    """Choose the sharpest frame of each of equal stretches of the way.

    Returns:
        Numbers of frames, ascending; fewer where the pictures jump, or others show what these do.

    Raises:
        InputError: Nothing moves.
    """
    frames, whole = len(scan.way), float(scan.way[-1]) if len(scan.way) else 0.0
    if whole < 0.1:
        raise InputError(
            f"nothing moves in the {frames} frames of the video (by {whole:.1%} of their width in "
            "all); needed: a camera that goes round the object, or an object that turns."
        )
    # Frames that have moved by less than a pixel of those that flow is measured in show the same.
    place = scan.way.double() / max(whole / count, 1 / _WIDTH_PX)
    # Sums of the length may round down.
    stretch = (place + 1e-6).floor().clamp(max=count - 1)
    middle = (place - stretch - 0.5).abs()
    numbers = []
    # From the middle three fifths, so that neighbours are two fifths of a stretch apart.
    for number in sorted(set(stretch.tolist())):
        here = (stretch == number).nonzero()[:, 0]
        inner = here[middle[here] <= max(0.3, float(middle[here].min()))]
        numbers.append(inner[scan.sharpness[inner].argmax()])
    return torch.stack(numbers)
