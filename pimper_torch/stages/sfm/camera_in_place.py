r"""The motion of a static background seen by a camera that only rotates or zooms.

If a camera turns about its centre, zooms, or its images are cropped, a static background moves
by one homography from image to image. For small turns it is a similarity with a perspective row, to
second order in the angle (2.7 px at the corner of 800 after a turn by 6.7 degrees, or 150 px):

.. math:: A \propto \begin{pmatrix} a & -b & t_u \\ b & a & t_v \\ p & q & 1 \end{pmatrix}

A plane that turns with the object, such as a table, also moves by homographies, but by
:math:`I + t n^T / d`, which shears and does not preserve angles.
"""

import cmath

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.geometry.colmap_library import loaded, quiet
from pimper_torch.geometry.pixels import homogeneous

# Zoom, and roll in radians, of a touched tripod or a cropped image: a choice.
_MAX_ZOOM, _MAX_ROLL = 1.3, 0.35


def follows_camera_in_place(
    first: Float[Tensor, "match 2"],
    second: Float[Tensor, "match 2"],
    centre: Float[Tensor, " 2"],
    max_error_px: float,
) -> Bool[Tensor, " match"]:
    """Return the matches that move as if the camera only rotated or zoomed.

    They follow the homography of most matches (RANSAC), after its shear is removed.

    Args:
        first: Pixels; they include outliers and points that turn.
        centre: Of the image; about it the map is a similarity with a perspective row.

    Returns:
        False everywhere if there is no homography, or not one of a small zoom and roll.
    """
    x, y = ((pixels - centre).double() for pixels in (first, second))
    options = loaded().RANSACOptions()
    options.max_error, options.random_seed = max_error_px, 0
    # With probability 0.99 one sample of four is of the background if that has 20 % of the matches.
    options.max_num_trials = 3000
    with quiet():
        found = loaded().estimate_homography_matrix(x.numpy(), y.numpy(), options)
    none = torch.zeros(len(x), dtype=torch.bool)
    if found is None:
        return none
    matrix = torch.from_numpy(found["H"] / found["H"][2, 2])
    (a, b), (c, d) = matrix[:2, :2].tolist()
    turn = complex(a + d, c - b) / 2
    if not (1 / _MAX_ZOOM < abs(turn) < _MAX_ZOOM and abs(cmath.phase(turn)) < _MAX_ROLL):
        return none
    matrix[:2, :2] = x.new_tensor([[turn.real, -turn.imag], [turn.imag, turn.real]])
    moved = homogeneous(x) @ matrix.mT
    return (moved[:, :2] / moved[:, 2:] - y).norm(dim=1) < max_error_px
