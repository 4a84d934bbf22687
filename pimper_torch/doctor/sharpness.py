"""Blur of the strongest edges of a photograph, in pixels."""

import torch
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter
from torch import Tensor
from torch.nn.functional import max_pool2d

# Smoothing before the two gradients that are compared: enough for noise, little beside the blur
# that is to be found.
_FINE, _WIDE = 1.0, 2.0
# Variance of the box that central differences over two pixels are.
_DIFFERENCE = 1 / 3
_CROP_PX = 1024  # the centre, where the object is
_EDGES, _MIN_EDGES = 400, 40  # of each orientation: the strongest, and too few to tell
_ORIENTATIONS = 4
_NOISE = 6.0  # medians of the gradient, above which it is an edge


def edge_blur_px(grey: Float[Tensor, "height width"]) -> float:
    r"""Measure the standard deviation of the blur at the strongest edges.

    An ideal edge under a Gaussian blur of variance :math:`s^2` has, after smoothing with variances
    :math:`a^2` and :math:`b^2`, gradients in the ratio
    :math:`R^2 = (s^2 + b^2) / (s^2 + a^2)`, so that :math:`s^2 = (b^2 - R^2 a^2) / (R^2 - 1)`.
    Edges are taken by orientation and the most blurred orientation counts, as motion blurs edges
    across it alone.

    Args:
        grey: Radiance, or any monotone function of it; the centre is looked at.

    Returns:
        NaN where there are no edges to tell it.

    Source: Zhuo & Sim, Defocus map estimation from a single image, Pattern Recognition 44, 2011.
    """
    grey = _centre(grey)
    fine, wide = _gradient(grey, _FINE), _gradient(grey, _WIDE)
    strength = torch.hypot(fine[0], fine[1])
    peaks = max_pool2d(strength[None, None], 3, 1, 1)[0, 0] == strength
    peaks &= strength > _NOISE * strength.median() + 1e-4
    angle = torch.atan2(fine[1], fine[0]) % torch.pi
    bins = (angle * (_ORIENTATIONS / torch.pi) + 0.5).floor() % _ORIENTATIONS
    found = [
        _blur(strength, torch.hypot(wide[0], wide[1]), peaks & (bins == one)) for one in range(4)
    ]
    known = [one for one in found if one == one]
    return max(known, default=float("nan"))


def _blur(
    fine: Float[Tensor, "height width"],
    wide: Float[Tensor, "height width"],
    edges: Bool[Tensor, "height width"],
) -> float:
    strength, other = fine[edges], wide[edges]
    if len(strength) < _MIN_EDGES:
        return float("nan")
    strongest = strength.topk(min(_EDGES, len(strength))).indices
    ratio = (strength[strongest] / other[strongest]).square().clamp_min(1 + 1e-6)
    a, b = _FINE**2 + _DIFFERENCE, _WIDE**2 + _DIFFERENCE
    variance = ((b - ratio * a) / (ratio - 1)).clamp_min(0)
    return float(variance.median().sqrt())


def _centre(grey: Float[Tensor, "height width"]) -> Float[Tensor, "rows columns"]:
    top, left = (max(0, (side - _CROP_PX) // 2) for side in grey.shape)
    return grey[top : top + _CROP_PX, left : left + _CROP_PX].float()


def _gradient(
    grey: Float[Tensor, "height width"], sigma: float
) -> Float[Tensor, "2 height_in width_in"]:
    smooth = torch.from_numpy(gaussian_filter(grey.numpy(), sigma, mode="nearest"))
    across = (smooth[1:-1, 2:] - smooth[1:-1, :-2]) / 2
    down = (smooth[2:, 1:-1] - smooth[:-2, 1:-1]) / 2
    return torch.stack([across, down])
