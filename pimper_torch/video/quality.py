"""Sharpness of a frame, and motion of the camera or the object since another."""

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

# Width of the pictures in which motion is measured. A choice: a hundredth of it is 3 pixels.
_WIDTH_PX = 320


# Lags in pixels: blur takes differences over the short one, and hardly those over the long one.
_SHORT, _LONG = 1, 4


def sharpness(luma: UInt8[Tensor, "height width"]) -> float:
    """Find how much neighbours differ, as a fraction of what pixels a little apart differ.

    It is that of rows or of columns, whichever is less: motion blurs along one of them. Brightness
    and contrast cancel. It compares frames of one video; 0 where nothing differs.
    """
    values = luma.to(torch.float32)
    return min(_finest(values), _finest(values.mT))


def _finest(values: Float[Tensor, "row column"]) -> float:
    short, long = (
        float((values[:, lag:] - values[:, :-lag]).square().mean()) for lag in (_SHORT, _LONG)
    )
    return short / long if long > 0 else 0.0


def thumbnail(luma: UInt8[Tensor, "height width"]) -> UInt8[np.ndarray, "height width"]:
    """Shrink a frame to where motion is measured."""
    height, width = luma.shape
    size = (_WIDTH_PX, max(16, round(height * _WIDTH_PX / width)))
    small: np.ndarray = cv2.resize(luma.numpy(), size, interpolation=cv2.INTER_AREA)
    return small


def motion(
    before: UInt8[np.ndarray, "height width"], after: UInt8[np.ndarray, "height width"]
) -> float:
    """Find how far what moves most has moved between thumbnails, as a fraction of their width.

    Source: Kroeger, Timofte, Dai, Van Gool, Fast optical flow using dense inverse search,
    ECCV 2016, for the flow.
    """
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST).calc(before, after, None)
    # An object that turns before a wall covers a fifth.
    return float(np.quantile(np.linalg.norm(flow, axis=2), 0.8)) / before.shape[1]
