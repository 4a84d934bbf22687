"""RGB primaries of files, and conversion of radiance to those of sRGB."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.radiometry.encoding import SATURATED
from pimper_torch.records.shapes import Matrix3

# Columns are the primaries of sRGB in XYZ, adapted to D50 as in ICC profiles ("sRGB").
_SRGB_D50 = torch.tensor(
    [
        [0.4360747, 0.3850649, 0.1430804],
        [0.2225045, 0.7168786, 0.0606169],
        [0.0139322, 0.0971045, 0.7141733],
    ],
    dtype=torch.float64,
    device="cpu",
)
# Cone responses of Bradford's adaptation, from ICC.1 annex E.
_BRADFORD = torch.tensor(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]],
    dtype=torch.float64,
    device="cpu",
)
_D50 = torch.tensor([0.9642, 1.0, 0.8249], dtype=torch.float64, device="cpu")
# Choices: maximum deviation of the rows' sums from 1, for primaries with a profile's rounded white;
# minimum weight at which a saturated colour saturates others, and minimum determinant.
_MAX_OFF_WHITE, _MIXED = 0.1, 0.01
# x and y of red, green, blue and white.
Chromaticities = Sequence[tuple[float, float]]
_D65 = (0.3127, 0.3290)
ADOBE_RGB: Chromaticities = ((0.64, 0.33), (0.21, 0.71), (0.15, 0.06), _D65)
REC_709: Chromaticities = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06), _D65)
REC_2020: Chromaticities = ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046), _D65)
DISPLAY_P3: Chromaticities = ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060), _D65)


def srgb_from_primaries(primaries_xyz: Matrix3) -> Matrix3 | None:
    """Return the matrix from linear values in given primaries to linear sRGB; white stays white.

    Args:
        primaries_xyz: Columns are red, green and blue in XYZ adapted to D50, as in ICC profiles.

    Returns:
        The identity if the primaries are those of sRGB; ``None`` if they are not valid primaries.
    """
    matrix = torch.linalg.solve(_SRGB_D50, primaries_xyz.double())
    white = matrix.sum(dim=1, keepdim=True)
    if not bool(matrix.isfinite().all()) or float(matrix.det().abs()) < _MIXED:
        return None
    if float((white - 1).abs().max()) > _MAX_OFF_WHITE:
        return None
    matrix, identity = matrix / white, torch.eye(3, dtype=torch.float64)
    # Profiles of sRGB differ in the rounding and adaptation of their white.
    return identity if float((matrix - identity).abs().max()) < 0.02 else matrix


def primaries_of(chromaticities: Chromaticities) -> Matrix3 | None:
    """Return primaries in XYZ adapted to D50 from x and y of red, green, blue and white.

    Adapted by Bradford's cone responses. ``None`` if they are dependent or a y is not positive.
    """
    xy = torch.tensor(chromaticities, dtype=torch.float64)
    if not bool((xy[:, 1] > 0).all()):
        return None
    xyz = torch.stack([xy[:, 0], xy[:, 1], 1 - xy.sum(dim=1)], dim=1) / xy[:, 1:]
    red_green_blue, white = xyz[:3].T, xyz[3]
    if float(red_green_blue.det().abs()) < _MIXED:
        return None
    primaries = red_green_blue * torch.linalg.solve(red_green_blue, white)
    adapted = _BRADFORD.inverse() @ torch.diag(_BRADFORD @ _D50 / (_BRADFORD @ white)) @ _BRADFORD
    return adapted @ primaries


def in_srgb_primaries(
    radiance: Float[Tensor, "3 height width"], srgb_from_file: Matrix3
) -> Float[Tensor, "3 height width"]:
    r"""Convert radiance to the primaries of sRGB, up to one factor.

    With :math:`M` the matrix, radiance becomes :math:`\max(0, M x) / s`, where :math:`s` is the
    largest sum of a row's positive entries: unsaturated values stay below 1. A colour with a
    contribution of a saturated one is saturated. Colours outside sRGB are clipped at 0.

    Args:
        radiance: Linear, 1 where saturated.
        srgb_from_file: Result of :func:`srgb_from_primaries`.
    """
    matrix = srgb_from_file.to(radiance)
    scale = matrix.clamp_min(0).sum(dim=1).max()
    mixed = torch.einsum("ij,jhw->ihw", matrix / scale, radiance)
    mixes = (matrix.abs() > _MIXED).to(radiance)
    saturated = torch.einsum("ij,jhw->ihw", mixes, (radiance >= SATURATED).to(radiance)) > 0
    return torch.where(saturated, 1.0, mixed.clamp(0, 1))
