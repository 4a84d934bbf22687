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
from jaxtyping import Bool, Complex128, Float
from torch import Tensor

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
    x, y = (torch.view_as_complex(pixels.double().contiguous()) for pixels in (first, second))
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
    x, y = (pixels - torch.view_as_complex(centre.double()) for pixels in (x, y))
    for _ in range(10):
        if follows.sum() < 8:
            break
        follows = _residuals(x, y, follows).abs() < max_error_px
    return follows


def _residuals(
    x: Complex128[Tensor, " match"], y: Complex128[Tensor, " match"], fitted: Bool[Tensor, " match"]
) -> Complex128[Tensor, " match"]:
    """Fit a similarity with a perspective row to some matches, and return the residuals of all.

    The fitted residuals are multiplied by the denominators, which are about 1 for small turns.
    """
    size = torch.view_as_real(x[fitted]).std().clamp_min(1e-9)
    x, y = x / size, y / size
    ones = torch.ones_like(x)
    columns = torch.stack([x, 1j * x, ones, 1j * ones, -x.real * y, -x.imag * y], dim=1)
    rows, right = torch.cat([columns.real, columns.imag]), torch.cat([y.real, y.imag])
    used = fitted.repeat(2)
    elements = torch.linalg.lstsq(rows[used], right[used, None], driver="gelsd").solution[:, 0]
    numerator = columns[:, :4] @ elements[:4].to(x)
    return size * (numerator / (1 + x.real * elements[4] + x.imag * elements[5]) - y)
