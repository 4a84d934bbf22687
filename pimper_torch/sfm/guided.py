"""More matches of verified pairs, along their epipolar lines.

A feature whose match is not clearly the best in the whole photograph may have one that is clearly
the best near its epipolar line. The rule is that of COLMAP's guided matching, which computes the
distances of all descriptors of two photographs; here only features near the line are compared,
about one in two hundred. A compiled kernel does it for two photographs in 30 ms.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.parallel import side_by_side
from pimper_torch.records import Record
from pimper_torch.sfm.binding import loaded, quiet
from pimper_torch.sfm.matching import PhotographPair, photograph_numbers
from pimper_torch.sfm.reconstruct_config import MIN_MATCHES, ReconstructConfig
from pimper_torch.sfm.workspace import Workspace

# Length of COLMAP's SIFT descriptors, in units of their bytes.
_DESCRIPTOR_LENGTH = 512.0


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Features(Record):
    """Features of one photograph.

    Attributes:
        descriptors: Of length 1, but for rounding.
    """

    pixels: Float[Tensor, "feature 2"]
    descriptors: Float[Tensor, "feature length"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Alike(Record):
    """Best matches of one photograph's features among the near ones of another.

    Attributes:
        products: Of the descriptors, the largest and the second largest; -1 where there is none.
        best: Which feature of the other photograph the largest is with, or -1.
    """

    products: Float[Tensor, "feature 2"]
    best: Int[Tensor, " feature"]


@dataclass(frozen=True, slots=True)
class Near:
    """Which pixels of two photographs can show the same point.

    Attributes:
        matrix: Fundamental matrix, or homography from the first photograph to the second.
        max_error_px: Largest distance: Sampson's from the epipolar line, or from the mapped point.
    """

    matrix: Float[Tensor, "3 3"]
    max_error_px: float
    planar: bool


def match_guided(
    space: Workspace, pairs: Sequence[PhotographPair], settings: ReconstructConfig
) -> None:
    """Replace the matches of verified pairs by those near their epipolar lines.

    Args:
        space: With pairs matched and verified.
        pairs: Which; those that are not verified stay as they are.
    """
    features: dict[int, Features] = {}
    with quiet(), loaded().Database.open(space.database) as stored:
        image_of = {number: image for image, number in photograph_numbers(stored, space).items()}
        geometries, nears = {}, {}
        for pair in pairs:
            ends = (image_of[pair[0]], image_of[pair[1]])
            geometry = stored.read_two_view_geometry(*ends)
            near = _near(geometry, settings.max_error_px)
            if near is not None:
                geometries[ends], nears[ends] = geometry, near
                features |= {
                    image: read_features(stored, image) for image in ends if image not in features
                }

        def matches(ends: tuple[int, int]) -> Int[Tensor, "match 2"]:
            first, second = (features[image] for image in ends)
            return guided_matches(first, second, nears[ends], settings.max_ratio)

        for ends, found in zip(geometries, side_by_side(matches, list(geometries)), strict=True):
            if len(found) >= MIN_MATCHES:
                geometries[ends].inlier_matches = found.numpy().astype(np.uint32)
                stored.update_two_view_geometry(*ends, geometries[ends])


def guided_matches(
    first: Features, second: Features, near: Near, max_ratio: float
) -> Int[Tensor, "match 2"]:
    """Match features among those that can show the same point.

    Args:
        max_ratio: Of the angles between a descriptor and the two most like it.
    """
    one, other = likeness(first, second, near)
    (some,) = torch.nonzero(_clearly_best(one, max_ratio), as_tuple=True)
    theirs = one.best[some]
    mutual = _clearly_best(other, max_ratio)[theirs] & (other.best[theirs] == some)
    return torch.stack([some, theirs], dim=1)[mutual]


def _near(geometry: Any, max_error_px: float) -> Near | None:  # noqa: ANN401 - pycolmap is untyped
    """Choose by what verified a pair; nothing for a pair that was not."""
    kinds = loaded().TwoViewGeometryConfiguration
    if geometry.config in (kinds.CALIBRATED, kinds.UNCALIBRATED):
        return Near(torch.from_numpy(np.array(geometry.F)), max_error_px, planar=False)
    if geometry.config in (kinds.PLANAR, kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC):
        return Near(torch.from_numpy(np.array(geometry.H)), max_error_px, planar=True)
    return None


def likeness(first: Features, second: Features, near: Near) -> tuple[Alike, Alike]:
    """Find the most similar features of two photographs, among those that can show one point."""
    from pimper_torch.kernels.line_matches import most_alike

    one, other = (
        Alike(
            products=torch.full((len(each.pixels), 2), -1.0),
            best=torch.full((len(each.pixels),), -1),
        )
        for each in (first, second)
    )
    most_alike(
        first.pixels.contiguous().numpy(),
        second.pixels.contiguous().numpy(),
        first.descriptors.contiguous().numpy(),
        second.descriptors.contiguous().numpy(),
        near.matrix.contiguous().numpy(),
        near.planar,
        near.max_error_px,
        one.products.numpy(),
        other.products.numpy(),
        one.best.numpy(),
        other.best.numpy(),
    )
    return one, other


def _clearly_best(alike: Alike, max_ratio: float) -> Bool[Tensor, " feature"]:
    """Find whose smallest angle is small, and the second smallest enough larger."""
    best, rival = alike.products.clamp(0, 1).acos().unbind(dim=1)  # without one, a right angle
    return (best < max_ratio * rival) & (
        best <= loaded().FeatureMatchingOptions().sift.max_distance
    )


def read_features(stored: Any, image: int) -> Features:  # noqa: ANN401 - pycolmap is untyped
    """Read the features of an image of the database."""
    pixels = np.array(stored.read_keypoints(image))[:, :2].astype(np.float64)
    descriptors = np.array(stored.read_descriptors(image).data).astype(np.float32)
    return Features(
        pixels=torch.from_numpy(pixels),
        descriptors=torch.from_numpy(descriptors / _DESCRIPTOR_LENGTH),
    )
