"""More matches of verified pairs, along their epipolar lines.

A feature whose match is not clearly the best in the whole photograph may have one that is clearly
the best near its epipolar line. The rule is that of COLMAP's guided matching, which computes the
distances of all descriptors of two photographs; here only features near the line are compared,
about one in two hundred.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.geometry.pixels import homogeneous
from pimper_torch.progress import track
from pimper_torch.records import Record
from pimper_torch.sfm.binding import loaded, quiet
from pimper_torch.sfm.matching import MatchSettings, PhotographPair, photograph_numbers
from pimper_torch.sfm.workspace import Workspace

# Features of the first photograph that are held against all of the second at once: a table of
# 256 by 5000 distances fits the cache.
_AT_ONCE = 256

# Candidates whose descriptors are compared at once: 4 MB, which fit the cache.
_COMPARED = 4096

# Length of COLMAP's SIFT descriptors, in units of their bytes.
_DESCRIPTOR_LENGTH = 512.0


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Features(Record):
    """Features of one photograph.

    Attributes:
        pixels: Where.
        descriptors: Of length 1, but for rounding.
    """

    pixels: Float[Tensor, "feature 2"]
    descriptors: Float[Tensor, "feature length"]


Near = Callable[[Float[Tensor, "first 2"], Float[Tensor, "second 2"]], Bool[Tensor, "first second"]]
"""Tells which pixels of two photographs can show the same point."""


def match_guided(
    space: Workspace, pairs: Sequence[PhotographPair], settings: MatchSettings
) -> None:
    """Replace the matches of verified pairs by those near their epipolar lines.

    Args:
        space: With pairs matched and verified.
        pairs: Which; those that are not verified stay as they are.
        settings: What counts as a match.
    """
    features: dict[int, Features] = {}
    with quiet(), loaded().Database.open(space.database) as stored:
        image_of = {number: image for image, number in photograph_numbers(stored, space).items()}
        for pair in track(pairs):
            ends = [image_of[view] for view in pair]
            geometry = stored.read_two_view_geometry(*ends)
            near = _near(geometry, settings.max_error_px)
            if near is None:
                continue
            for image in ends:
                if image not in features:
                    features[image] = _read_features(stored, image)
            first, second = (features[image] for image in ends)
            found = guided_matches(first, second, near, settings.max_ratio)
            if len(found) >= settings.min_inliers:
                geometry.inlier_matches = found.numpy().astype(np.uint32)
                stored.update_two_view_geometry(*ends, geometry)


def guided_matches(
    first: Features, second: Features, near: Near, max_ratio: float
) -> Int[Tensor, "match 2"]:
    """Match features among those that can show the same point.

    Args:
        first: Of one photograph.
        second: Of another.
        near: Which can.
        max_ratio: Of the angles between a descriptor and the two most like it.

    Returns:
        Features that are each other's best match.
    """
    pairs = torch.cat(list(_candidates(first, second, near)))
    if not len(pairs):
        return pairs
    angles = torch.cat(
        [
            (first.descriptors[some[:, 0]] * second.descriptors[some[:, 1]]).sum(dim=1)
            for some in torch.split(pairs, _COMPARED)
        ]
    )
    angles = angles.clamp_max(1).acos()
    chosen = [_clearly_best(pairs[:, side], angles, max_ratio) for side in range(2)]
    return pairs[chosen[0] & chosen[1]]


def near_epipolar_lines(fundamental: Float[Tensor, "3 3"], max_error_px: float) -> Near:
    """Hold pixels against the epipolar geometry, to first order (Sampson's distance)."""

    def near(
        first: Float[Tensor, "first 2"], second: Float[Tensor, "second 2"]
    ) -> Bool[Tensor, "first second"]:
        lines = homogeneous(first) @ fundamental.mT
        back = homogeneous(second) @ fundamental
        # From the middle of all on, single precision tells a hundredth of a pixel.
        middle = second.mean(dim=0)
        offsets = (lines[:, :2] @ middle + lines[:, 2]).float()
        residual = torch.addmm(offsets[:, None], lines[:, :2].float(), (second - middle).float().mT)
        slopes = [ends[:, :2].square().sum(dim=1).float() for ends in (lines, back)]
        return residual.square_() <= max_error_px**2 * (slopes[0][:, None] + slopes[1])

    return near


def near_mapped_points(homography: Float[Tensor, "3 3"], max_error_px: float) -> Near:
    """Hold pixels against those that a homography maps to."""

    def near(
        first: Float[Tensor, "first 2"], second: Float[Tensor, "second 2"]
    ) -> Bool[Tensor, "first second"]:
        mapped = homogeneous(first) @ homography.mT
        mapped = mapped[:, :2] / mapped[:, 2:]
        gap = mapped[:, None] - second
        return gap.square().sum(dim=2) <= max_error_px**2

    return near


def _near(geometry: Any, max_error_px: float) -> Near | None:  # noqa: ANN401 - pycolmap is untyped
    """Choose by what verified a pair; nothing for a pair that was not."""
    kinds = loaded().TwoViewGeometryConfiguration
    if geometry.config in (kinds.CALIBRATED, kinds.UNCALIBRATED):
        return near_epipolar_lines(torch.from_numpy(np.array(geometry.F)), max_error_px)
    if geometry.config in (kinds.PLANAR, kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC):
        return near_mapped_points(torch.from_numpy(np.array(geometry.H)), max_error_px)
    return None


def _candidates(
    first: Features, second: Features, near: Near
) -> Iterator[Int[Tensor, "candidate 2"]]:
    yield torch.zeros(0, 2, dtype=torch.long)
    for start in range(0, len(first.pixels), _AT_ONCE):
        here = torch.nonzero(near(first.pixels[start : start + _AT_ONCE], second.pixels))
        yield here + here.new_tensor([start, 0])


def _clearly_best(
    group: Int[Tensor, " candidate"], angles: Float[Tensor, " candidate"], max_ratio: float
) -> Bool[Tensor, " candidate"]:
    """Mark in each group the smallest angle, where the second smallest is enough larger."""
    order = angles.argsort()
    order = order[group[order].argsort(stable=True)]
    named, sorted_angles = group[order], angles[order]
    ahead = torch.ones_like(named, dtype=torch.bool)
    ahead[1:] = named[1:] != named[:-1]
    rival = torch.full_like(sorted_angles, torch.pi / 2)  # of a group of one
    rival[:-1] = torch.where(ahead[1:], rival[:-1], sorted_angles[1:])
    best = ahead & (sorted_angles < max_ratio * rival)
    best &= sorted_angles <= loaded().FeatureMatchingOptions().sift.max_distance
    return torch.zeros_like(best).index_copy(0, order, best)


def _read_features(stored: Any, image: int) -> Features:  # noqa: ANN401 - pycolmap is untyped
    pixels = np.array(stored.read_keypoints(image))[:, :2].astype(np.float64)
    descriptors = np.array(stored.read_descriptors(image).data).astype(np.float32)
    return Features(
        pixels=torch.from_numpy(pixels),
        descriptors=torch.from_numpy(descriptors / _DESCRIPTOR_LENGTH),
    )
