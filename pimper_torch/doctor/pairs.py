"""Overlap of photographs and variation of their light, by features of small copies."""

from collections.abc import Iterator, Sequence
from statistics import median

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from pimper_torch.doctor.findings import Finding, ok, warned
from pimper_torch.doctor.photograph import Photograph
from pimper_torch.errors import some
from pimper_torch.radiometry import SATURATED
from pimper_torch.records import Views
from pimper_torch.sfm.features import SMALLEST_PX, find_features, workspace
from pimper_torch.sfm.matching import VerifiedPair, all_pairs, match_pairs, verified_pairs
from pimper_torch.sfm.reconstruct_config import ReconstructConfig

_MIN_MATCHES = 30
# Of four rendered scenes of 12 photographs, mug and potatoes: 0.02 and 0.01 under constant light,
# 0.47 and 0.18 under a point light that moves; 0.11 of the demo's skull, whose flash is on the
# camera.
_CONSTANT = 0.04


def match_copies(copies: Sequence[Float[Tensor, "rows columns"]]) -> list[VerifiedPair]:
    """Match small copies with one another; pairs that have nothing in common are left out."""
    large = [index for index, copy in enumerate(copies) if min(copy.shape) >= SMALLEST_PX]
    if len(large) < 2:
        return []
    height, width = (max(copies[index].shape[axis] for index in large) for axis in (0, 1))
    padded = [
        pad(copies[index], (0, width - copies[index].shape[1], 0, height - copies[index].shape[0]))
        for index in large
    ]
    views = Views(
        images=torch.stack(padded)[:, None],
        sizes_px=torch.tensor([copies[index].shape[::-1] for index in large]),
        names=tuple(map(str, large)),
        masks=None,
        focals_px=torch.full((len(large),), torch.nan),
    )
    settings = ReconstructConfig(peak_threshold=0.004, max_features=1500, affine_shape=False)
    # Those next to one another first: round a turntable the last is by the first.
    count = len(large)
    pairs = sorted(
        all_pairs(count), key=lambda pair: min(pair[1] - pair[0], count - pair[1] + pair[0])
    )
    with workspace(views, settings.num_threads) as space:
        find_features(space, settings, [None] * count, range(count))
        # Of 40 photographs all pairs; fewer verified matches come about by chance.
        match_pairs(space, pairs[:800], settings, 12)
        return [
            pair.replace(views=(large[pair.views[0]], large[pair.views[1]]))
            for pair in verified_pairs(space)
        ]


def overlap(names: Sequence[str], matches: Sequence[VerifiedPair]) -> Iterator[Finding]:
    """Return whether matches connect all photographs."""
    count = len(names)
    if count < 2:
        return
    links = np.array([pair.views for pair in matches], dtype=np.int64).reshape(-1, 2)
    usual = sorted(np.bincount(links.flatten(), minlength=count))[count // 2]
    graph = coo_array((np.ones(len(links)), tuple(links.T)), shape=(count, count))
    group = connected_components(graph, directed=False)[1]
    largest = np.bincount(group).argmax()
    apart = [name for name, one in zip(names, group, strict=True) if one != largest]
    found = f"each photograph matches {usual} others in the median"
    if not apart:
        yield ok("overlap", f"{found}, all of them connected")
        return
    yield warned(
        "overlap",
        f"{found}; {len(apart)} of {count} are not connected with the rest: {some(apart, 4)}",
        "two neighbours each, and one connected group",
        "Take photographs in between, 10 to 15 degrees apart. This is a quick look at small "
        "copies: a run may still connect them.",
    )


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
    near = torch.cdist(pixels, pixels).topk(9, largest=False).indices
    smooth = ratio[near].median(dim=1).values
    return 1.4826 * float((smooth - smooth.median()).abs().median())


def variations(photographs: Sequence[Photograph], matches: Sequence[VerifiedPair]) -> list[float]:
    """Measure :func:`light_variation` of every pair with enough matches to tell it."""
    found = []
    means = [_mean(one) for one in photographs]
    for match in matches:
        one, other = (means[index] for index in match.views)
        here, there = _at(one, match.first), _at(other, match.second)
        # Below, a level of 8 bits is a fifth of the value; NaN where saturated.
        kept = (here > 0.004) & (there > 0.004)
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
        torch.stack([one.small, burnt]), 5, 1, 2, count_include_pad=False
    )
    return torch.where(saturated > 0, torch.nan, radiance)


def _at(
    mean: Float[Tensor, "rows columns"], pixels: Float[Tensor, "feature 2"]
) -> Float[Tensor, " feature"]:
    u, v = pixels.long().unbind(dim=1)
    return mean[v.clamp(0, mean.shape[0] - 1), u.clamp(0, mean.shape[1] - 1)]
