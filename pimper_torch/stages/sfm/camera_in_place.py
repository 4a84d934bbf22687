r"""The motion of a static background seen by a camera that only rotates or zooms.

If a camera turns about its centre, zooms, or its images are cropped, a static background moves
by one homography from image to image. For small turns it is a similarity with a perspective row, to
second order in the angle (2.7 px at the corner of 800 after a turn by 6.7 degrees, or 150 px):

.. math:: A \propto \begin{pmatrix} a & -b & t_u \\ b & a & t_v \\ p & q & 1 \end{pmatrix}

A plane that turns with the object, such as a table, also moves by homographies, but by
:math:`I + t n^T / d`, which shears and does not preserve angles.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.geometry.pixels import homogeneous
from pimper_torch.records.shapes import Matrix3

# Zoom, and roll in radians, of a touched tripod or a cropped image: a choice.
_MAX_ZOOM, _MAX_ROLL = 1.3, 0.35


def follows_camera_in_place(
    first: Float[Tensor, "match 2"],
    second: Float[Tensor, "match 2"],
    centre: Float[Tensor, " 2"],
    max_error_px: float,
    generator: torch.Generator,
) -> Bool[Tensor, " match"]:
    """Return the matches that move as if the camera only rotated or zoomed.

    Similarities through two matches each are hypotheses (RANSAC). The best is refined with the
    perspective row by least squares over its inliers.

    Args:
        first: Pixels; they include outliers and points that turn.
        centre: Of the image; about it the map is a similarity with a perspective row.

    Returns:
        False everywhere if no hypothesis is a small zoom and roll.
    """
    none = torch.zeros(len(first), dtype=torch.bool)
    if len(first) < 2:
        return none
    first, second = first.double(), second.double()
    x, y = (torch.view_as_complex(pixels.contiguous()) for pixels in (first, second))
    # With probability 0.99 one pair is of the background if that has 15 % of the matches.
    start, stop = torch.randint(len(x), (2, 200), generator=generator)
    scale = (y[stop] - y[start]) / (x[stop] - x[start])  # not finite if both are one match
    small = (scale.abs().log().abs() < math.log(_MAX_ZOOM)) & (scale.angle().abs() < _MAX_ROLL)
    scale, shift = scale[small], (y[start] - scale * x[start])[small]
    if len(scale) == 0:
        return none
    sample = torch.randperm(len(x), generator=generator)[:2000]
    # Without perspective, a map is valid in a part of the image only.
    error = (scale[:, None] * x[sample] + shift[:, None] - y[sample]).abs()
    best = int((error < 2 * max_error_px).sum(dim=1).argmax())
    follows = (scale[best] * x + shift[best] - y).abs() < 2 * max_error_px
    for _ in range(10):
        if follows.sum() < 8:
            break
        matrix = least_squares_map(first[follows], second[follows], centre)
        follows = (mapped(matrix, first) - second).norm(dim=1) < max_error_px
    return follows


def least_squares_map(
    first: Float[Tensor, "match 2"], second: Float[Tensor, "match 2"], centre: Float[Tensor, " 2"]
) -> Matrix3:
    """Fit a similarity with a perspective row about a centre; float64.

    The residuals are multiplied by the denominators, which are about 1 for small turns.
    """
    size = first.std().clamp_min(1e-9)
    x, y = (first - centre) / size, (second - centre) / size
    ones, zeros = torch.ones_like(x[:, :1]), torch.zeros_like(x[:, :1])
    u, v = x[:, :1], x[:, 1:]
    linear = [torch.cat([u, -v, ones, zeros], dim=1), torch.cat([v, u, zeros, ones], dim=1)]
    rows = torch.cat(
        [torch.cat([terms, -y[:, axis, None] * x], dim=1) for axis, terms in enumerate(linear)]
    )
    a, b, u0, v0, p, q = torch.linalg.lstsq(rows, y.mT.reshape(-1, 1), driver="gelsd").solution[
        :, 0
    ]
    elements = torch.stack([a, -b, u0, b, a, v0, p, q, torch.ones_like(a)])
    scaling = torch.diag(torch.stack([1 / size, 1 / size, torch.ones_like(size)]))
    scaling[:2, 2] = -centre / size
    return torch.linalg.solve(scaling, elements.reshape(3, 3) @ scaling)


def mapped(matrix: Matrix3, pixels: Float[Tensor, "pixel 2"]) -> Float[Tensor, "pixel 2"]:
    """Return pixels mapped by a homography; float64."""
    projective = homogeneous(pixels.double()) @ matrix.mT
    return projective[:, :2] / projective[:, 2:]
