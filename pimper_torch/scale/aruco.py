"""Detection and drawing of ArUco markers by OpenCV. Imports ``cv2``."""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import map_coordinates
from torch import Tensor

from pimper_torch.geometry import pixels
from pimper_torch.records.shapes import Map

# Without error correction, 587 x 4 of 2^36 squares of random cells are detected as a marker: 3 in
# 10^8. DICT_4X4_50, with 2^16 squares, would have 3 in 10^3.
_FAMILY = cv2.aruco.DICT_APRILTAG_36h11

Corners = Float[Tensor, "square 4 2"]

CELLS = 8
"""Cells along a marker's side, including its black border."""


def find_squares(picture: UInt8[Tensor, "height width"]) -> dict[int, Float[Tensor, "4 2"]]:
    """Detect AprilTags of family 36h11 in an image, without error correction.

    A code that occurs twice is skipped, because it is ambiguous in other images.

    Args:
        picture: Grey, encoded by a curve such as sRGB.

    Returns:
        Pixels of the outer corners of each black border, by code (0 to 586): clockwise from the
        marker's top left, as OpenCV detects them, accurate to about a pixel.
    """
    settings = cv2.aruco.DetectorParameters()
    settings.errorCorrectionRate = 0.0
    family = cv2.aruco.getPredefinedDictionary(_FAMILY)
    detector = cv2.aruco.ArucoDetector(family, settings)
    corners, ids, _ = detector.detectMarkers(np.ascontiguousarray(picture.numpy()))
    if ids is None:
        return {}
    codes = np.ravel(ids).tolist()
    indices = torch.from_numpy(np.array(corners, np.float64).reshape(-1, 4, 2))
    detected = zip(codes, pixels.pixels_from_indices(indices), strict=True)
    return {code: square_corners for code, square_corners in detected if codes.count(code) == 1}


def cells_of(code: int) -> Bool[Tensor, "8 8"]:
    """Return the cells of the marker with this code; true is black."""
    family = cv2.aruco.getPredefinedDictionary(_FAMILY)
    return torch.from_numpy(cv2.aruco.generateImageMarker(family, code, CELLS) < 128)


# Half-length of a profile: in cells, as the border is one black cell; at least the pixel blur.
_REACH, _MIN_REACH_PX = 0.6, 1.5


def refined_corners(picture: Map, corners: Corners) -> Corners:
    """Refine corners of squares by intersecting lines fitted to their sides.

    Profiles are sampled across each side. An edge is at the centroid of the profile's gradient,
    whatever the blur, if the image is linear. OpenCV's corners are up to half a pixel inside.

    Args:
        picture: Linear radiance, black squares on white; NaN where unknown. Profiles across such
            pixels do not count.
        corners: Pixels, accurate to about two pixels; clockwise in the image.

    Returns:
        The refined corners; NaN where most profiles of a side have no edge.
    """
    refined = corners.double()
    for _ in range(4):
        refined = _refined_once(picture.double(), refined)
    return refined


def _refined_once(picture: Map, corners: Corners) -> Corners:
    along = corners.roll(-1, dims=1) - corners
    length = along.norm(dim=-1, keepdim=True)
    outward = torch.stack([along[..., 1], -along[..., 0]], dim=-1) / length
    reach = (_REACH * length.mean(dim=(1, 2)) / CELLS).nan_to_num(0).clamp_min(_MIN_REACH_PX)
    along_side = torch.linspace(0.1, 0.9, 24).to(corners)  # profiles at corners cross two sides
    count = 2 * int((4 * reach.max()).ceil()) + 1 if len(reach) else 3
    across = reach[:, None] * torch.linspace(-1, 1, count).to(corners)
    base = corners[:, :, None] + along_side[:, None] * along[:, :, None]
    sample_pixels = base[:, :, :, None] + across[:, None, None, :, None] * outward[:, :, None, None]
    indices = pixels.indices_from_pixels(sample_pixels).flip(-1).movedim(-1, 0).numpy()
    profiles = map_coordinates(picture.numpy(force=True), indices, order=1, mode="nearest")
    steps = torch.from_numpy(profiles).diff(dim=-1).clamp_min(0)  # keeps NaN
    midpoints = ((across[:, 1:] + across[:, :-1]) / 2)[:, None, None]
    total = steps.sum(dim=-1)
    offsets = (steps * midpoints).sum(dim=-1) / total
    # Homogeneous coordinates: cross products give lines through points and intersections of lines.
    ends = torch.stack([corners, corners + along], dim=-2)
    ends = ends + _line(along_side, offsets) * outward[:, :, None]
    lines = torch.linalg.cross(*pixels.homogeneous(ends).unbind(dim=-2))
    intersections = torch.linalg.cross(lines.roll(1, dims=1), lines)
    return intersections[..., :2] / intersections[..., 2:]


def _line(
    along_side: Float[Tensor, " along"], offsets: Float[Tensor, "square 4 along"]
) -> Float[Tensor, "square 4 2 1"]:
    """Fit a line to the edge offsets along each side with Cauchy weights; return it at the ends."""
    valid = offsets.isfinite()
    values = offsets.nan_to_num(0)[..., None]
    basis = torch.stack([1 - along_side, along_side], dim=1)  # of both ends
    predicted = offsets.nanmedian(dim=-1, keepdim=True).values[..., None]
    for _ in range(3):
        weighted = basis * (valid[..., None] / (1 + ((values - predicted) / 0.3).square()))
        # Singular where hardly any offset is valid; such sides become NaN below.
        ends = torch.linalg.solve_ex(weighted.mT @ basis, weighted.mT @ values).result
        predicted = basis @ ends
    return torch.where(valid.double().mean(dim=-1)[..., None, None] > 0.5, ends, torch.nan)
