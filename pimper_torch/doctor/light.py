"""Variation of light between photographs, where both see the same points."""

from collections.abc import Iterator, Sequence
from statistics import median

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from pimper_torch.doctor.findings import Finding, ok, warned
from pimper_torch.doctor.photograph import Photograph
from pimper_torch.radiometry import SATURATED
from pimper_torch.sfm.matching import VerifiedPair

_WINDOW = 5  # pixels of the small copy round a feature, as blobs are
_NEIGHBOURS = 9  # features whose median tells shading, which is smooth, from noise, which is not
_MIN_MATCHES = 30
_DARK = 0.004  # of saturation: below, a level of 8 bits is a fifth of the value
# Of four rendered scenes of 12 photographs, mug and potatoes: 0.02 and 0.01 under constant light,
# 0.47 and 0.18 under a point light that moves; 0.11 of the demo's skull, whose flash is on the
# camera.
_CONSTANT = 0.04
_GAUSSIAN = 1.4826  # standard deviations in a median absolute deviation


def light_variation(
    first: Float[Tensor, " feature"],
    second: Float[Tensor, " feature"],
    pixels: Float[Tensor, "feature 2"],
) -> float:
    r"""Measure how the light of two photographs differs beyond their exposure.

    At features of the same surface, radiance of a matte surface has the ratio of the two shadings.
    Under the same light this is the ratio of exposures, the same everywhere. Its logarithm, minus
    its median, is smoothed over neighbours, by their median, and its spread is told.

    Args:
        first: Radiance at the features of one photograph.
        pixels: Where they are in the first.

    Returns:
        Robust standard deviation of the logarithm of the ratio of shadings: 0.1 is 10 per cent.
    """
    ratio = (second / first).log()
    near = torch.cdist(pixels, pixels).topk(_NEIGHBOURS, largest=False).indices
    smooth = ratio[near].median(dim=1).values
    return _GAUSSIAN * float((smooth - smooth.median()).abs().median())


def variations(photographs: Sequence[Photograph], matches: Sequence[VerifiedPair]) -> list[float]:
    """Measure :func:`light_variation` of every pair with enough matches to tell it."""
    found = []
    means = [_mean(one) for one in photographs]
    for match in matches:
        one, other = (means[index] for index in match.views)
        here, there = _at(one, match.first), _at(other, match.second)
        kept = (here > _DARK) & (there > _DARK)  # NaN where saturated
        if kept.sum() >= _MIN_MATCHES:
            found.append(light_variation(here[kept], there[kept], match.first[kept]))
    return found


def light(found: Sequence[float]) -> Iterator[Finding]:
    """Return whether the light varies from photograph to photograph."""
    if not found:
        yield warned(
            "light",
            "no two photographs have enough features in common to compare their light",
            f"{_MIN_MATCHES} matches",
            "Photographs closer to one another, or with more texture, would tell.",
            "note",
        )
        return
    middle = median(found)
    told = f"shading differs by {middle:.1%} between photographs, in the median of {len(found)} "
    if middle >= _CONSTANT:
        yield ok("light", f"light varies: {told}pairs")
        return
    yield warned(
        "light",
        f"light hardly varies: {told}pairs",
        f"{_CONSTANT:.0%} or more",
        "Normals come from light that moves. Move the lamp between photographs, or use the flash "
        "of the camera in a dark room; else texture alone tells the shape.",
    )


def _mean(one: Photograph) -> Float[Tensor, "rows columns"]:
    """Average radiance over windows; NaN where some of it is saturated."""
    burnt = (one.small_saturated >= SATURATED).to(one.small)
    radiance, saturated = avg_pool2d(
        torch.stack([one.small, burnt]), _WINDOW, 1, _WINDOW // 2, count_include_pad=False
    )
    return torch.where(saturated > 0, torch.nan, radiance)


def _at(
    mean: Float[Tensor, "rows columns"], pixels: Float[Tensor, "feature 2"]
) -> Float[Tensor, " feature"]:
    u, v = pixels.long().unbind(dim=1)
    return mean[v.clamp(0, mean.shape[0] - 1), u.clamp(0, mean.shape[1] - 1)]
