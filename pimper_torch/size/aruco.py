"""Detection and drawing of ArUco markers by OpenCV. Imports ``cv2``."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from pimper_torch.geometry.pixels import pixels_from_indices
from pimper_torch.records import Record

# Of 2^36 squares of random cells 587 x 4 are read as a marker where no cell may be wrong: 3 in
# 10^8. Of DICT_4X4_50, with its 2^16, it would be 3 in 10^3.
_FAMILY = cv2.aruco.DICT_APRILTAG_36h11

CELLS = 8
"""Cells along a marker's side, with its black border."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Square(Record):
    """A marker in a photograph.

    Attributes:
        code: Its number, of 587.
        corners: Pixels of the black border's outer corners, clockwise from the marker's top left;
            to about a pixel as OpenCV gives them.
    """

    code: int
    corners: Float[Tensor, "4 2"]


def find_squares(picture: UInt8[Tensor, "height width"]) -> list[Square]:
    """Find AprilTags of the family 36h11 in a picture, none of whose cells is misread.

    A number that stands twice is left out: no one can tell which is which in other pictures.

    Args:
        picture: Grey, encoded by a curve such as sRGB.
    """
    settings = cv2.aruco.DetectorParameters()
    settings.errorCorrectionRate = 0.0
    family = cv2.aruco.getPredefinedDictionary(_FAMILY)
    detector = cv2.aruco.ArucoDetector(family, settings)
    corners, codes, _ = detector.detectMarkers(np.ascontiguousarray(picture.numpy()))
    if codes is None:
        return []
    numbers = [int(code) for code in np.ravel(codes)]
    return [
        Square(
            code=code,
            corners=pixels_from_indices(torch.from_numpy(np.array(four, np.float64).reshape(4, 2))),
        )
        for code, four in zip(numbers, corners, strict=True)
        if numbers.count(code) == 1
    ]


def cells_of(code: int) -> Bool[Tensor, "8 8"]:
    """Return the cells of a marker, true where they are black."""
    family = cv2.aruco.getPredefinedDictionary(_FAMILY)
    return torch.from_numpy(cv2.aruco.generateImageMarker(family, code, CELLS) < 128)
