"""Which photographs show the same, by features of small copies."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.doctor.findings import Finding, listed
from pimper_torch.parallel import side_by_side
from pimper_torch.radiometry import to_bytes
from pimper_torch.records import Record
from pimper_torch.sfm.binding import loaded, quiet

_MAX_FEATURES, _PEAK_THRESHOLD = 1500, 0.004
_MAX_PAIRS = 800  # of 40 photographs all; of more those next in the order of their names
_MAX_RATIO, _MAX_ERROR_PX = 0.8, 2.0
_LINKED = 12  # verified matches: fewer come about by chance


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Features(Record):
    """Where features are, and what is round them, of unit length."""

    pixels: Float[Tensor, "feature 2"]
    descriptors: Float[Tensor, "feature 128"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Match(Record):
    """Features of two photographs that the same epipolar geometry explains.

    Attributes:
        pair: Numbers of the photographs.
        first: Where the features are in the first small copy.
        second: Where they are in the second.
    """

    pair: Int[Tensor, " 2"]
    first: Float[Tensor, "feature 2"]
    second: Float[Tensor, "feature 2"]


def match_copies(copies: Sequence[Float[Tensor, "rows columns"]]) -> list[Match]:
    """Match small copies with one another; pairs that have nothing in common are left out."""
    with quiet():
        features = list(side_by_side(_features, copies))
        pairs = _pairs(len(copies))
        found = side_by_side(lambda pair: _matched(features, pair), pairs)
        return [match for match in found if match is not None]


def overlap(names: Sequence[str], matches: Sequence[Match]) -> Iterator[Finding]:
    """Return whether matches connect all photographs."""
    if len(names) < 2:
        return
    links = {tuple(match.pair.tolist()) for match in matches}
    groups = _components(len(names), links)
    neighbours = [sum(index in pair for pair in links) for index in range(len(names))]
    usual = sorted(neighbours)[len(names) // 2]
    apart = [names[index] for group in groups[1:] for index in group]
    found = f"each photograph matches {usual} others in the median"
    if apart:
        yield Finding(
            check="overlap",
            severity="warning",
            found=f"{found}; {len(apart)} of {len(names)} are not connected with the rest: "
            f"{listed(apart)}",
            needed="two neighbours each, and one connected group",
            advice="Take photographs in between, 10 to 15 degrees apart. This is a quick look at "
            "small copies: a run may still connect them.",
        )
        return
    yield Finding(check="overlap", severity="ok", found=f"{found}, all of them connected")


def _features(small: Float[Tensor, "rows columns"]) -> Features:
    pycolmap = loaded()

    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, 1
    options.sift.max_num_features = _MAX_FEATURES
    options.sift.peak_threshold = _PEAK_THRESHOLD
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    pixels = np.ascontiguousarray(to_bytes(small))
    keypoints, found = extractor.extract(pycolmap.Bitmap.from_array(pixels))
    descriptors = torch.from_numpy(np.array(found.data, dtype=np.float32))
    places = [(one.x, one.y) for one in keypoints]
    return Features(
        pixels=torch.tensor(places, dtype=torch.float32).reshape(-1, 2),
        descriptors=torch.nn.functional.normalize(descriptors.reshape(-1, 128), dim=1),
    )


def _pairs(count: int) -> list[tuple[int, int]]:
    """List pairs, those next to one another first: round a turntable the last is by the first."""
    everything = list(combinations(range(count), 2))
    everything.sort(key=lambda pair: min(pair[1] - pair[0], count - pair[1] + pair[0]))
    return everything[:_MAX_PAIRS]


def _matched(features: Sequence[Features], pair: tuple[int, int]) -> Match | None:
    one, other = features[pair[0]], features[pair[1]]
    if min(len(one.pixels), len(other.pixels)) < _LINKED:
        return None
    likeness = one.descriptors @ other.descriptors.T
    best, nearest = likeness.topk(2, dim=1)
    distance = (2 - 2 * best).clamp_min(0).sqrt()
    mutual = likeness.argmax(dim=0)[nearest[:, 0]] == torch.arange(len(nearest))
    kept = (distance[:, 0] < _MAX_RATIO * distance[:, 1]) & mutual
    first, second = one.pixels[kept], other.pixels[nearest[kept, 0]]
    if len(first) < _LINKED:
        return None
    inliers = _verified(first, second)
    if inliers.sum() < _LINKED:
        return None
    return Match(pair=torch.tensor(pair), first=first[inliers], second=second[inliers])


def _verified(first: Float[Tensor, "feature 2"], second: Float[Tensor, "feature 2"]) -> Tensor:
    pycolmap = loaded()

    options = pycolmap.RANSACOptions()
    options.max_error, options.max_num_trials, options.random_seed = _MAX_ERROR_PX, 1000, 0
    found = pycolmap.estimate_fundamental_matrix(
        first.double().numpy(), second.double().numpy(), options
    )
    if found is None:
        return torch.zeros(len(first), dtype=torch.bool)
    return torch.from_numpy(np.array(found["inlier_mask"], dtype=bool))


def _components(count: int, links: set[tuple[int, ...]]) -> list[list[int]]:
    """Return the connected groups of photographs, the largest first."""
    group = list(range(count))
    for first, second in links:
        old, new = group[second], group[first]
        group = [new if one == old else one for one in group]
    members = [[index for index in range(count) if group[index] == one] for one in set(group)]
    return sorted(members, key=len, reverse=True)
