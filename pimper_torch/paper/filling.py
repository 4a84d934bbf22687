"""Carrying what is known over what is not."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate


def fill_smoothly(
    values: Float[Tensor, "patch channel height width"],
    weight: Float[Tensor, "patch height width"],
) -> Float[Tensor, "patch channel height width"]:
    """Assign every sample without weight a smooth blend of those with weight around it.

    Push and pull through a pyramid of halved rasters: holes are filled from the finest
    level that knows anything there.

    Args:
        values: Kept exactly where ``weight`` is 1; what they are where it is 0, NaN
            included, does not matter.
        weight: In [0, 1].

    Returns:
        Finite everywhere; zero in a patch without any weight. Differentiable.

    Source: Gortler et al., The Lumigraph, SIGGRAPH 1996, section 3.4.
    """
    fraction = weight[:, None]
    return _regularization(torch.where(fraction > 0, values, 0) * fraction, fraction)


def _regularization(
    weighted: Float[Tensor, "patch channel height width"],
    weight: Float[Tensor, "patch 1 height width"],
) -> Float[Tensor, "patch channel height width"]:
    size = weight.shape[-2:]
    known = torch.where(weight > 0, weighted / torch.where(weight > 0, weight, 1), 0)
    if max(size) == 1:
        return known
    coarse_weight = _halved(weight)
    coarse_weighted = _halved(weighted)
    # A parent of one known child knows as much as that child: without saturation, thin
    # evidence would fade on its way up, and the mean of the whole patch would win.
    full = (4 * coarse_weight).clamp_max(1)
    gain = full / torch.where(coarse_weight > 0, coarse_weight, 1)
    coarse = _regularization(coarse_weighted * gain, full)
    around = interpolate(coarse, size=size, mode="bilinear", align_corners=False)
    return weight * known + (1 - weight) * around


def _halved(
    raster: Float[Tensor, "patch channel height width"],
) -> Float[Tensor, "patch channel half_height half_width"]:
    window = [min(2, side) for side in raster.shape[-2:]]
    return avg_pool2d(raster, kernel_size=window, stride=window, ceil_mode=True)
