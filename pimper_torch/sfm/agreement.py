"""Whether a model agrees with the matches it was made of.

Where two sides of an object look alike, COLMAP can register every photograph with small
reprojection errors, and put a part of them on the wrong side: a mapper leaves out what
contradicts it. The pairs with most matches are those of neighbouring photographs, and nearly all
their matches agree with a right model; those of a misplaced view do not. Pairs with few matches
do not tell: a third of a carton's disagree with the right model, too, for its sides look alike.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from kornia.geometry.epipolar import essential_from_Rt, fundamental_from_essential
from torch import Tensor

from pimper_torch.records import Cameras
from pimper_torch.sfm.colmap import pinhole_of, undistort_pixels
from pimper_torch.sfm.matching import PhotographPair, VerifiedPair
from pimper_torch.sfm.model import SparseModel
from pimper_torch.sfm.static_background import sampson_errors

# Pairs that judge a view. Of the matches in its 3 strongest pairs, 91 to 100 % agree for the worst
# view of 4 right models of a carton, 4 to 31 % in 3 wrong models; in its strongest pair alone 77 to
# 100 %, in its 6 strongest 85 to 90 %.
_JUDGES = 3

# Fraction of those matches that must agree.
_MIN_AGREEMENT = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Judgement:
    """Agreement of a model with the verified matches of its photographs.

    Attributes:
        explained: Fraction of all verified matches that the model's epipolar geometry explains;
            matches of photographs that the model lacks are not explained.
        misplaced: By name, views that contradict most matches of their strongest pairs, with the
            fraction that agrees.
    """

    explained: float
    misplaced: Mapping[str, float]


def judged(
    model: SparseModel, files: Sequence[str], pairs: Sequence[VerifiedPair], max_error_px: float
) -> Judgement:
    """Compare a model with verified matches.

    Args:
        model: Its names are among ``files``.
        max_error_px: Distance from the model's epipolar geometry up to which a match agrees.
    """
    view_of = {files.index(name): view for view, name in enumerate(model.names)}
    inside = [
        pair.replace(views=(view_of[pair.views[0]], view_of[pair.views[1]]))
        for pair in pairs
        if all(number in view_of for number in pair.views)
    ]
    agrees = match_errors(model, inside) <= max_error_px
    counts = [pair.num_matches for pair in inside]
    agreeing = {
        pair.views: (pair.num_matches, float(some.double().mean()))
        for pair, some in zip(inside, torch.split(agrees, counts), strict=True)
    }
    misplaced = {}
    for view, name in enumerate(model.names):
        mine = [agreeing[pair] for pair in agreeing if view in pair]
        fraction = _agreeing_fraction(sorted(mine, reverse=True)[:_JUDGES])
        if fraction < _MIN_AGREEMENT:
            misplaced[name] = fraction
    total = sum(pair.num_matches for pair in pairs)
    compared = sum(count for count, _ in agreeing.values())
    explained = _agreeing_fraction(agreeing.values()) * compared / total if total else 0.0
    return Judgement(explained=explained, misplaced=misplaced)


def _agreeing_fraction(pairs: Collection[tuple[int, float]]) -> float:
    total = sum(count for count, _ in pairs)
    return sum(count * fraction for count, fraction in pairs) / total if total else 1.0


def agreement(model: SparseModel, pair: VerifiedPair, max_error_px: float) -> float:
    """Return the fraction of a pair's matches that the model's epipolar geometry explains."""
    return float((match_errors(model, [pair]) <= max_error_px).double().mean())


def match_errors(model: SparseModel, pairs: Sequence[VerifiedPair]) -> Float[Tensor, " match"]:
    """Measure Sampson's distances of matches from the epipolar lines of a model, in pixels."""
    cameras = pinholes_of(model)
    errors = [
        sampson_errors(epipolar_geometry(cameras, pair.views), pair.first, pair.second)
        for pair in undistorted_pairs(model, pairs)
    ]
    return torch.cat([*errors, torch.zeros(0, dtype=torch.float64)])


def undistorted_pairs(
    model: SparseModel, pairs: Sequence[VerifiedPair]
) -> tuple[VerifiedPair, ...]:
    """Undistort matches by the lenses of a model."""
    return tuple(
        pair.replace(
            first=undistorted_pixels(model, pair.views[0], pair.first),
            second=undistorted_pixels(model, pair.views[1], pair.second),
        )
        for pair in pairs
    )


def pinholes_of(model: SparseModel) -> Cameras:
    """Return the pinholes behind a model's lenses."""
    intrinsics = [pinhole_of(lens) for lens in model.lenses]
    sizes = [[lens.width, lens.height] for lens in model.lenses]
    return Cameras(
        intrinsics=torch.stack(intrinsics) if intrinsics else torch.zeros(0, 3, 3).double(),
        cam_from_world=model.cam_from_world,
        sizes_px=torch.tensor(sizes).reshape(-1, 2).long(),
    )


def epipolar_geometry(cameras: Cameras, views: PhotographPair) -> Float[Tensor, "3 3"]:
    """Return ``F`` of two views, with ``second^T F first = 0`` for undistorted pixels."""
    poses = (cameras.cam_from_world[view] for view in views)
    motion = (part for pose in poses for part in (pose[:3, :3], pose[:3, 3:]))
    intrinsics = (cameras.intrinsics[view] for view in views)
    geometry: Tensor = fundamental_from_essential(essential_from_Rt(*motion), *intrinsics)
    return geometry


def undistorted_pixels(
    model: SparseModel, view: int, pixels: Float[Tensor, "match 2"]
) -> Float[Tensor, "match 2"]:
    """Return where a pinhole of the lens's own focal length has pixels of a photograph."""
    K = pinhole_of(model.lenses[view])
    plane = undistort_pixels(model.lenses[view], pixels)
    return plane * K.diagonal()[:2] + K[:2, 2]
