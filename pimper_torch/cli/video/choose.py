"""Selection of frames of a video: the sharpest ones, evenly spaced by motion."""

from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from pimper_torch.runtime.errors import InputError

# Width of the images in which motion is measured; chosen by hand (1 % is 3 pixels).
_WIDTH_PX = 320
# Motion, as a fraction of the width, up to which frames are compared with the same earlier frame,
# so that noise is added once per step. Chosen by hand: 6 pixels of 320, where flow is reliable.
_STEP = 0.02
Thumbnail = UInt8[np.ndarray, "height width"]


class Scan(NamedTuple):
    """Sharpness of every frame of a video, and motion since the first, in frame widths."""

    sharpness: Float[Tensor, " frame"]
    way: Float[Tensor, " frame"]


def scanned(frames: Iterable[UInt8[Tensor, "height width"]]) -> Scan:
    """Return sharpness and cumulative motion of the frames of a video."""
    sharp, way = list[float](), list[float]()
    key_frame, total = None, 0.0
    for luma in frames:
        small = thumbnail(luma)
        moved = 0.0 if key_frame is None else motion(key_frame, small)
        sharp.append(sharpness(luma))
        way.append(total + moved)
        if key_frame is None or moved > _STEP:
            key_frame, total = small, total + moved
    return Scan(torch.tensor(sharp), torch.tensor(way).cummax(dim=0).values)


def sharpness(luma: UInt8[Tensor, "height width"]) -> float:
    """Return the mean squared difference of adjacent pixels over that of pixels 4 apart.

    It is the minimum over rows and columns, because motion may blur along one of them. Brightness
    and contrast cancel. It is comparable between frames of one video; 0 for constant frames.
    """
    finest = []
    for values in (luma.float(), luma.float().mT):
        near, far = (float((values[:, lag:] - values[:, :-lag]).square().mean()) for lag in (1, 4))
        finest.append(near / far if far > 0 else 0.0)
    return min(finest)


def thumbnail(luma: UInt8[Tensor, "height width"]) -> Thumbnail:
    """Return a frame at the size in which motion is measured."""
    height, width = luma.shape
    size = (_WIDTH_PX, max(16, round(height * _WIDTH_PX / width)))
    return cv2.resize(luma.numpy(), size, interpolation=cv2.INTER_AREA)


def motion(before: Thumbnail, after: Thumbnail) -> float:
    """Return the motion between thumbnails, as a fraction of their width: a high quantile.

    Source: Kroeger et al., Fast optical flow using dense inverse search, ECCV 2016.
    """
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST).calc(before, after, None)
    # An object that turns in front of a static wall may cover only a fifth of the frame.
    return float(np.quantile(np.linalg.norm(flow, axis=2), 0.8)) / before.shape[1]


def chosen(scan: Scan, count: int) -> Int[Tensor, " chosen"]:
    """Return the sharpest frame of each of ``count`` equal intervals of the motion.

    Returns:
        Ascending numbers of frames; fewer than ``count`` if the picture jumps or hardly moves.

    Raises:
        InputError: Nothing moves.
    """
    frames, total = len(scan.way), float(scan.way[-1]) if len(scan.way) else 0.0
    if total < 0.1:
        raise InputError(
            f"nothing moves in the {frames} frames of the video (by {total:.1%} of their width in "
            "total); needed: a camera that moves around the object, or an object that turns."
        )
    # An interval is at least one pixel of the thumbnails; less motion than that is a copy.
    position = scan.way.double() / max(total / count, 1 / _WIDTH_PX)
    # The sum of the motion may round down.
    interval = (position + 1e-6).floor().clamp(max=count - 1)
    off_centre = (position - interval - 0.5).abs()
    numbers = []
    # Only the middle three fifths of an interval, so selected frames are two fifths apart.
    for number in sorted(set(interval.tolist())):
        members = (interval == number).nonzero()[:, 0]
        inner = members[off_centre[members] <= max(0.3, float(off_centre[members].min()))]
        numbers.append(inner[scan.sharpness[inner].argmax()])
    return torch.stack(numbers)
