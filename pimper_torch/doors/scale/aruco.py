"""Detection and drawing of ArUco markers by OpenCV. Imports ``cv2``."""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import map_coordinates
from torch import Tensor

from pimper_torch.ground.geometry import pixels
from pimper_torch.ground.shapes import Map

# Of 2^36 squares of random cells 587 x 4 are read as a marker where no cell may be wrong: 3 in
# 10^8. Of DICT_4X4_50, with its 2^16, it would be 3 in 10^3.
_FAMILY = cv2.aruco.DICT_APRILTAG_36h11

Corners = Float[Tensor, "square 4 2"]

CELLS = 8
"""Cells along a marker's side, with its black border."""


def find_squares(picture: UInt8[Tensor, "height width"]) -> dict[int, Float[Tensor, "4 2"]]:
    """Find AprilTags of the family 36h11 in a picture, none of whose cells is misread.

    A number that occurs twice is left out: nothing says which marker is which in other pictures.

    Args:
        picture: Grey, encoded by a curve such as sRGB.

    Returns:
        Pixels of the outer corners of each black border, by the marker's number of 587: clockwise
        from the marker's top left, to about a pixel, as OpenCV finds them.
    """
    settings = cv2.aruco.DetectorParameters()
    settings.errorCorrectionRate = 0.0
    family = cv2.aruco.getPredefinedDictionary(_FAMILY)
    detector = cv2.aruco.ArucoDetector(family, settings)
    corners, codes, _ = detector.detectMarkers(np.ascontiguousarray(picture.numpy()))
    if codes is None:
        return {}
    numbers = np.ravel(codes).tolist()
    indices = torch.from_numpy(np.array(corners, np.float64).reshape(-1, 4, 2))
    found = zip(numbers, pixels.pixels_from_indices(indices), strict=True)
    return {code: four for code, four in found if numbers.count(code) == 1}


def cells_of(code: int) -> Bool[Tensor, "8 8"]:
    """Return the cells of a marker, true where they are black."""
    family = cv2.aruco.getPredefinedDictionary(_FAMILY)
    return torch.from_numpy(cv2.aruco.generateImageMarker(family, code, CELLS) < 128)


# Reach of a profile: of a cell, as the border is one cell of black; at least pixels' own blur.
_REACH, _MIN_REACH_PX = 0.6, 1.5


def refined_corners(picture: Map, corners: Corners) -> Corners:
    """Intersect lines through the sides of squares.

    Across each side profiles are read; a step is where their gradient has its centroid, whatever
    the blur, as long as the picture is linear. OpenCV's own corners are up to half a pixel inside.

    Args:
        picture: Linear radiance, black squares on white; NaN where unknown. Profiles across such
            pixels do not count.
        corners: Pixels, to about two of them; clockwise, as seen.

    Returns:
        The same corners; NaN where most profiles of a side have no step.
    """
    found = corners.double()
    for _ in range(4):
        found = _refined_once(picture.double(), found)
    return found


def _refined_once(picture: Map, corners: Corners) -> Corners:
    along = corners.roll(-1, dims=1) - corners
    length = along.norm(dim=-1, keepdim=True)
    outward = torch.stack([along[..., 1], -along[..., 0]], dim=-1) / length
    reach = (_REACH * length.mean(dim=(1, 2)) / CELLS).nan_to_num(0).clamp_min(_MIN_REACH_PX)
    share = torch.linspace(0.1, 0.9, 24).to(corners)  # near a corner the other side is near
    count = 2 * int((4 * reach.max()).ceil()) + 1 if len(reach) else 3
    across = reach[:, None] * torch.linspace(-1, 1, count).to(corners)
    base = corners[:, :, None] + share[:, None] * along[:, :, None]
    places = base[:, :, :, None] + across[:, None, None, :, None] * outward[:, :, None, None]
    at = pixels.indices_from_pixels(places).flip(-1).movedim(-1, 0).numpy()
    read = map_coordinates(picture.numpy(force=True), at, order=1, mode="nearest")
    steps = torch.from_numpy(read).diff(dim=-1).clamp_min(0)  # keeps NaN
    middle = ((across[:, 1:] + across[:, :-1]) / 2)[:, None, None]
    total = steps.sum(dim=-1)
    off = (steps * middle).sum(dim=-1) / total
    # Lines as their vectors of homogeneous coordinates: cross products join points and meet lines.
    ends = torch.stack([corners, corners + along], dim=-2) + _line(share, off) * outward[:, :, None]
    lines = torch.linalg.cross(*pixels.homogeneous(ends).unbind(dim=-2))
    meeting = torch.linalg.cross(lines.roll(1, dims=1), lines)
    return meeting[..., :2] / meeting[..., 2:]


def _line(
    share: Float[Tensor, " along"], off: Float[Tensor, "square 4 along"]
) -> Float[Tensor, "square 4 2 1"]:
    """Fit lines to offsets along each side with Cauchy's weights; give them at its ends."""
    known = off.isfinite()
    values = off.nan_to_num(0)[..., None]
    basis = torch.stack([1 - share, share], dim=1)  # of both ends
    predicted = off.nanmedian(dim=-1, keepdim=True).values[..., None]
    for _ in range(3):
        weighted = basis * (known[..., None] / (1 + ((values - predicted) / 0.3).square()))
        # Singular where next to nothing is known, which is left out below.
        ends = torch.linalg.solve_ex(weighted.mT @ basis, weighted.mT @ values).result
        predicted = basis @ ends
    return torch.where(known.double().mean(dim=-1)[..., None, None] > 0.5, ends, torch.nan)
