r"""The colour and strength of each view's light, relative to all views.

Chromaticity is that of the albedo times that of the light, whatever the shading: the logarithm of
each channel over the channels' geometric mean is a sum of a term per sample and a term per view.
So is the logarithm of brightness, except for shading.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.kernels.twin_constants import MIN_DEVIATION
from pimper_torch.lighting.light_models import left_out, predicts_better
from pimper_torch.linalg.robust import CAUCHY_TUNING, cauchy_weights, robust_deviation

# Stops by which a photograph is brightened at most: below an eighth of the others' brightness,
# residuals are mostly sensor noise. Views within this many stops of the median count as equally
# exposed, since lamps move and their irradiance falls off. Choices.
_MOST_STOPS, _SAME_STOPS = 3.0, 1.5


@torch.no_grad()
def light_colours(
    radiance: Float[Tensor, "sample view channel"], seen: Bool[Tensor, "sample view"]
) -> Float[Tensor, "view channel"]:
    """Fit the colour of each view's light; white if colours do not predict better.

    Args:
        radiance: Linear. Entries that are not seen are ignored.
        seen: False where missing.

    Returns:
        Factors of the channels. Their geometric mean over the views is nearly the same for all
        channels, and the samples' mean albedo is as bright under each as under white.

    Not differentiable.
    """
    seen = seen & (radiance > 0).all(dim=2)
    white = radiance.new_ones(radiance.shape[1:])
    if not seen.any():
        return white
    chroma = radiance.double().where(seen[..., None], 1).log()
    chroma = chroma - chroma.mean(dim=2, keepdim=True)
    test = left_out(seen)
    misfits = []
    for free in (False, True):
        colour, albedo = _fit(chroma, seen & ~test, free)
        distance = (chroma - albedo[:, None] - colour).norm(dim=2).clamp_min(MIN_DEVIATION)
        misfits.append(torch.where(test, distance, torch.nan).nanmedian(dim=0).values)
    if not predicts_better(misfits[1], misfits[0]):
        return white
    colour, albedo = _fit(chroma, seen, True)
    colour, share = colour.exp(), albedo[seen.any(dim=1)].exp().mean(dim=0)
    return (colour * share.sum() / (colour @ share)[:, None]).to(radiance)


@torch.no_grad()
def exposures(
    radiance: Float[Tensor, "sample view"], seen: Bool[Tensor, "sample view"]
) -> Float[Tensor, " view"]:
    """Return the brightness of each view, as a power of two, relative to the median view.

    Radiance over it has residuals of similar size in all views, so an under-exposed photograph
    counts as much as others. All are 1 if the strengths of lights are similar.

    Args:
        radiance: Gray, linear. Entries that are not seen are ignored.
        seen: False where missing.

    Not differentiable.
    """
    seen = seen & (radiance > 0)
    if not seen.any():
        return radiance.new_ones(radiance.shape[1])
    brightness = radiance.double().where(seen, 1).log2()[..., None]
    stops = _fit(brightness, seen, True)[0][:, 0]
    observed = seen.any(dim=0)
    stops = torch.where(observed, stops - stops[observed].median(), 0)
    if bool((stops.abs() < _SAME_STOPS).all()):
        return radiance.new_ones(radiance.shape[1])
    return stops.round().clamp_min(-_MOST_STOPS).exp2().to(radiance)


def _fit(
    chroma: Float[Tensor, "sample view channel"], seen: Bool[Tensor, "sample view"], free: bool
) -> tuple[Float[Tensor, "view channel"], Float[Tensor, "sample channel"]]:
    """Fit a term per view, with zero mean, and a term per sample, by robust least squares.

    Args:
        chroma: Logarithms, of any number of channels.
        free: Whether views have terms at all.
    """
    colour, weight = chroma.new_zeros(chroma.shape[1:]), seen.to(chroma)
    for _ in range(8):
        total = weight.sum(dim=1, keepdim=True).clamp_min(1e-300)
        if free:
            matrix = torch.diag(weight.sum(dim=0)) - weight.mT @ (weight / total)
            mean = torch.einsum("sv,svc->sc", weight, chroma) / total
            side = torch.einsum("sv,svc->vc", weight, chroma - mean[:, None])
            colour = torch.linalg.pinv(matrix, hermitian=True) @ side
            colour = colour - colour.mean(dim=0)
        albedo = torch.einsum("sv,svc->sc", weight, chroma - colour) / total
        distance = (chroma - albedo[:, None] - colour).norm(dim=2) * seen
        scale = CAUCHY_TUNING * robust_deviation(distance.mT, seen.mT).clamp_min(MIN_DEVIATION)
        weight = seen * cauchy_weights(distance, scale)
    return colour, albedo
