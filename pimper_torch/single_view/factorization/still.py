"""Whether photographs show the same surface at the same pixels, as those of a fixed camera do."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

# Widths of the band of details in pixels: wider than noise, narrower than shading; choices.
_NARROW, _WIDE = 3, 9
_DARKEST, _MAX_CONTRAST = 0.02, 0.3  # of encoded values, and of details in their logarithm
_MIN_CONTRAST = 2e-3  # root mean square of details; half a level of 255 in the middle
# Variance in the band over that above it: 0.11 for noise that is independent from pixel to pixel.
_MIN_TEXTURE = 0.3
# Correlation of two views' details where they lie, in standard deviations of that at all other
# shifts: 0 for views of a moving camera, 4 and more for those of a fixed one; a choice between.
_MIN_AGREEMENT = 1.5


def camera_moved(
    encoded: Float[Tensor, "view channel height width"], where: Bool[Tensor, "height width"]
) -> bool:
    """Return whether details of the photographs lie at other pixels in every one.

    Details are those of the logarithm of the values, between pixel noise and shading, so that
    light hardly changes them. False where the photographs have none.
    """
    logs = encoded.mean(dim=1, keepdim=True).clamp_min(_DARKEST).log()
    smooth = _mean(logs, _NARROW)
    where = where.clone()
    where[:_WIDE], where[-_WIDE:] = False, False  # means lean to one side there
    where[:, :_WIDE], where[:, -_WIDE:] = False, False
    details = where * (smooth - _mean(smooth, _WIDE)).clamp(-_MAX_CONTRAST, _MAX_CONTRAST)[:, 0]
    grain = where * (logs - smooth).clamp(-_MAX_CONTRAST, _MAX_CONTRAST)[:, 0]
    texture = details.square().sum(dim=(1, 2)) / grain.square().sum(dim=(1, 2)).clamp_min(1e-12)
    contrast = (details.square().sum(dim=(1, 2)) / where.sum().clamp_min(1)).sqrt()
    if float(texture.median()) < _MIN_TEXTURE or float(contrast.median()) < _MIN_CONTRAST:
        return False
    spectra = torch.fft.rfft2(details)
    count = len(details)
    agreements = []
    for first in range(count):
        for second in {(first + 1) % count, (first + count // 2) % count}:
            product = spectra[first] * spectra[second].conj()
            correlation = torch.fft.irfft2(product, s=details.shape[1:])
            spread = correlation.std().clamp_min(1e-12)
            agreements.append(correlation[0, 0] / spread)
    return float(torch.stack(agreements).median()) < _MIN_AGREEMENT


def _mean(
    planes: Float[Tensor, "view 1 height width"], size: int
) -> Float[Tensor, "view 1 height width"]:
    return avg_pool2d(planes, size, 1, size // 2, count_include_pad=False)
