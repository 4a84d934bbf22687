r"""The motion of a background in front of a camera that stays in its place.

A camera that turns about its centre, zooms, or has its pictures cropped sees a background at rest
move by one homography from photograph to photograph. With small turns it is a similarity with a
perspective row, to the second order of the angle (2.7 px at the corner of 800 after a turn by 6.7
degrees, or 150 px):

.. math:: A \propto \begin{pmatrix} a & -b & t_u \\ b & a & t_v \\ p & q & 1 \end{pmatrix}

A plane that turns with the object, such as a table, moves by homographies, too, but by
:math:`I + t n^T / d`, which shears and does not preserve angles.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.ground.geometry.pixels import homogeneous
from pimper_torch.ground.shapes import Matrix3

# Zoom, and roll in radians, of a touched tripod or of a cropped picture: a choice.
_MAX_ZOOM, _MAX_ROLL = 1.3, 0.35


def follows_camera_in_place(
    first: Float[Tensor, "match 2"],
    second: Float[Tensor, "match 2"],
    centre: Float[Tensor, " 2"],
    max_error_px: float,
    generator: torch.Generator,
) -> Bool[Tensor, " match"]:
    """Find the matches that move as before a camera in its place.

    Similarities through two matches each are hypotheses (RANSAC); the best is refined with the
    perspective row by least squares of the matches that follow.

    Args:
        first: Pixels, also of matches that are wrong or of what turns.
        centre: Of the picture; about it the map is a similarity with a perspective row.

    Returns:
        False everywhere where no hypothesis is a small zoom and roll.
    """
    none = torch.zeros(len(first), dtype=torch.bool)
    if len(first) < 2:
        return none
    first, second = first.double(), second.double()
    x, y = (torch.view_as_complex(end.contiguous()) for end in (first, second))
    # Enough to hit two of the room once at 0.99 where it has 15 % of the matches.
    one, other = torch.randint(len(x), (2, 200), generator=generator)
    scale = (y[other] - y[one]) / (x[other] - x[one])  # not finite where both are one match
    small = (scale.abs().log().abs() < math.log(_MAX_ZOOM)) & (scale.angle().abs() < _MAX_ROLL)
    scale, shift = scale[small], (y[one] - scale * x[one])[small]
    if len(scale) == 0:
        return none
    some = torch.randperm(len(x), generator=generator)[:2000]
    # Without perspective, a map is right in a part of the picture only.
    error = (scale[:, None] * x[some] + shift[:, None] - y[some]).abs()
    most = int((error < 2 * max_error_px).sum(dim=1).argmax())
    follows = (scale[most] * x + shift[most] - y).abs() < 2 * max_error_px
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
    one, zero = torch.ones_like(x[:, :1]), torch.zeros_like(x[:, :1])
    u, v = x[:, :1], x[:, 1:]
    linear = [torch.cat([u, -v, one, zero], dim=1), torch.cat([v, u, zero, one], dim=1)]
    rows = torch.cat(
        [torch.cat([part, -y[:, side, None] * x], dim=1) for side, part in enumerate(linear)]
    )
    found = torch.linalg.lstsq(rows, y.mT.reshape(-1, 1), driver="gelsd").solution[:, 0]
    a, b, right, down, p, q = found
    elements = torch.stack([a, -b, right, b, a, down, p, q, torch.ones_like(a)])
    between = torch.diag(torch.stack([1 / size, 1 / size, torch.ones_like(size)]))
    between[:2, 2] = -centre / size
    return torch.linalg.solve(between, elements.reshape(3, 3) @ between)


def mapped(matrix: Matrix3, pixels: Float[Tensor, "pixel 2"]) -> Float[Tensor, "pixel 2"]:
    """Map pixels by a homography; float64."""
    found = homogeneous(pixels.double()) @ matrix.mT
    return found[:, :2] / found[:, 2:]
