r"""Features of a room that is at rest before the camera while the object turns.

Where camera and room stand still and the object turns, as on a turntable, two motions fit the
photographs: the object's, and none at all. A match whose features lie at the same pixel is *still*.
A rigid scene has still matches, too: points at infinity before a camera that only shifts, or points
near the axis of a turn. But there one epipolar geometry explains them together with the matches
that move. No geometry explains a room at rest together with an object that turns.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from kornia.geometry.epipolar import normalize_points, sampson_epipolar_distance
from torch import Tensor

from pimper_torch.geometry.pixels import homogeneous
from pimper_torch.progress import track
from pimper_torch.records import Record

# Features at rest that were found less exactly are no evidence of motion: in rendered rooms 1 in
# 100 is 1 to 4 px off.
_CLEARLY = 4.0
# Of the moving matches. Simulated with 0.2 px of noise: 0.00 in rigid scenes; before a room at
# rest 0.2 with the camera 2 degrees over the table's plane, 0.5 from 10, 0.8 from 25.
_CONTRADICTION = 0.1
# Pairs verified together; the first, which show most of both, must contradict one geometry: else no
# more are verified. A choice.
_TOGETHER = 24
# Fits with other weights: in simulation the fraction of violations changes by 0.01 at most after 6.
_ITERATIONS = 6


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Pair(Record):
    """Matched features of two photographs.

    Attributes:
        matches: A feature of the first and one of the second in each row.
    """

    first: int
    second: int
    matches: Int[Tensor, "match 2"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class StaticBackground(Record):
    """Static background of photographs.

    Attributes:
        features: True for those of a room at rest, one tensor a photograph.
        still_fraction: Of all matches, those whose features lie at the same pixel.
        moving_pairs: Pairs with still matches in which others move by one epipolar geometry.
        violating_fraction: Of the moving matches in those, the ones that no geometry explains
            together with the still ones; 0 without such pairs.
        shift_px: How far the room shifts in a photograph, at most, before a camera that was turned
            in its place or whose pictures were cropped; 0 where it is at rest.
        maps: From the pixels of each photograph to those where the room is at rest; NaN where a
            photograph shows too little of it; none without a room.
    """

    features: tuple[Bool[Tensor, " _"], ...]
    still_fraction: float
    moving_pairs: int
    violating_fraction: float
    shift_px: float = 0.0
    maps: tuple[Float[Tensor, "3 3"], ...] = ()

    @property
    def room(self) -> bool:
        """True where something is at rest while something else moves."""
        return self.violating_fraction > _CONTRADICTION

    @property
    def nothing_moves(self) -> bool:
        """True where most matches are still, and nowhere do enough others move."""
        return self.still_fraction > 0.5 and self.moving_pairs == 0


Keypoints = Sequence[Float[Tensor, "_ 2"]]  # one length a photograph
Ends = tuple[Float[Tensor, "_ 2"], Float[Tensor, "_ 2"]]  # of matches, in two photographs
Verify = Callable[[Sequence[Pair]], Sequence[Int[Tensor, "match 2"]]]


def find_static_background(
    keypoints: Keypoints,
    pairs: Sequence[Pair],
    verify: Verify,
    *,
    still_px: float,
    max_error_px: float,
    fewest: int,
) -> StaticBackground:
    """Report features of a room at rest from those of what moves.

    Each pair that has both still matches and moving ones that one epipolar geometry explains
    votes: a still match says that its features rest, a moving one that they move. Features rest
    where more says so, unless one geometry explains still and moving matches together: then
    the scene is rigid and all its features stay. Pairs of identical photographs have no moving
    matches and do not vote.

    Args:
        verify: Gives those matches of each pair that one epipolar geometry explains; called for
            moving matches only.
        still_px: Distance between the features of a still match, less than.
        max_error_px: Sampson error above which a match violates a geometry.
        fewest: Matches below which a pair does not vote.
    """
    votes = [torch.zeros(len(one), dtype=torch.long) for one in keypoints]  # for rest
    num_moving = num_violating = moving_pairs = 0
    split = [_split(keypoints, pair, still_px) for pair in pairs]
    shown = [min(len(one.matches) for one in both) for both in split]
    order = sorted(range(len(pairs)), key=shown.__getitem__, reverse=True)
    telling = [split[index] for index in order if shown[index] >= fewest]
    for start in track(range(0, len(telling), _TOGETHER)):
        some = telling[start : start + _TOGETHER]
        verified = verify([moving for _, moving in some])
        for (resting, moving), right in zip(some, verified, strict=True):
            if len(right) < fewest:
                continue
            moving = moving.replace(matches=right)
            ends = _pixels(keypoints, moving)
            geometry = shared_geometry(_pixels(keypoints, resting), ends, max_error_px)
            moving_pairs += 1
            num_moving += len(moving.matches)
            num_violating += int((sampson_errors(geometry, *ends) > max_error_px).sum())
            _count(votes, resting, 1)
            _count(votes, moving, -1)
        if num_moving and num_violating <= _CONTRADICTION * num_moving:
            break
    num_still = sum(len(still.matches) for still, _ in split)
    fraction = num_violating / max(num_moving, 1)
    return StaticBackground(
        features=tuple((one > 0) & (fraction > _CONTRADICTION) for one in votes),
        still_fraction=num_still / max(sum(len(pair.matches) for pair in pairs), 1),
        moving_pairs=moving_pairs,
        violating_fraction=fraction,
    )


def moving_matches(
    keypoints: Keypoints, pair: Pair, rest: StaticBackground, still_px: float
) -> Bool[Tensor, " match"]:
    """Find matches that are neither still nor of a feature at rest."""
    first, second = pair.matches.unbind(dim=1)
    touched = rest.features[pair.first][first] | rest.features[pair.second][second]
    return ~touched & ~is_still(keypoints, pair, still_px)


def is_still(keypoints: Keypoints, pair: Pair, still_px: float) -> Bool[Tensor, " match"]:
    """Find matches whose features lie at the same pixel."""
    first, second = _pixels(keypoints, pair)
    return (first - second).norm(dim=-1) < still_px


def shared_geometry(still: Ends, moving: Ends, max_error_px: float) -> Float[Tensor, "3 3"]:
    """Fit the fundamental matrix that explains still and moving matches best; float64.

    The eight-point algorithm, reweighted for Cauchy's loss of Sampson's distance. Both kinds weigh
    the same. Every translation explains the still ones, so that it is mostly the moving ones that
    violate the result where no geometry explains both.

    Args:
        still: Pixels in the first and in the second photograph.
    """
    first, second = (torch.cat(ends).double() for ends in zip(still, moving, strict=True))
    count = torch.tensor([len(still[0]), len(moving[0])])
    weight = even = (1 / count.double()).repeat_interleave(count)
    for _ in range(_ITERATIONS):
        geometry = fundamental_matrix(first, second, weight)
        error = sampson_errors(geometry, first, second)
        lines = torch.cat([homogeneous(first) @ geometry.mT, homogeneous(second) @ geometry], dim=1)
        gradient = lines[:, [0, 1, 3, 4]].square().sum(dim=1)  # of the algebraic residual
        tiny = torch.finfo(gradient.dtype).tiny
        weight = even / (gradient.clamp_min(tiny) * (1 + (error / max_error_px).square()))
    return geometry


def fundamental_matrix(
    first: Float[Tensor, "match 2"],
    second: Float[Tensor, "match 2"],
    weight: Float[Tensor, " match"],
) -> Float[Tensor, "3 3"]:
    """Fit ``F``, with ``second^T F first = 0``, by weighted least squares; float64.

    kornia's ``find_fundamental`` weighs the normalization of the pixels, too: reweighted, still and
    moving matches that contradict one another then violate the fit as little as 2 %, here 26 % at
    least (30 turntables of two photographs).

    Args:
        first: Pixels, 8 or more.

    Source: Hartley, In Defense of the Eight-Point Algorithm, PAMI 19(6), 1997.
    """
    x, from_first = (part[0] for part in normalize_points(first.double()[None]))
    y, from_second = (part[0] for part in normalize_points(second.double()[None]))
    rows = (homogeneous(y)[:, :, None] * homogeneous(x)[:, None, :]).flatten(1)
    least = torch.linalg.eigh(rows.mT @ (weight[:, None] * rows)).eigenvectors[:, 0]
    u, s, v = torch.linalg.svd(least.reshape(3, 3))
    s[2] = 0
    return from_second.mT @ (u * s) @ v @ from_first


def sampson_errors(
    geometry: Float[Tensor, "3 3"],
    first: Float[Tensor, "match 2"],
    second: Float[Tensor, "match 2"],
) -> Float[Tensor, " match"]:
    """Return the first-order distance of matches from an epipolar geometry, in pixels."""
    ends = first.double(), second.double()
    errors: Tensor = sampson_epipolar_distance(*ends, geometry, squared=False)
    return errors


def _split(keypoints: Keypoints, pair: Pair, still_px: float) -> tuple[Pair, Pair]:
    """Return a pair with its still matches, and with those that clearly move."""
    first, second = _pixels(keypoints, pair)
    length = (first - second).norm(dim=-1)
    still, moving = length < still_px, length >= _CLEARLY * still_px
    return pair.replace(matches=pair.matches[still]), pair.replace(matches=pair.matches[moving])


def _pixels(keypoints: Keypoints, pair: Pair) -> Ends:
    first, second = pair.matches.unbind(dim=1)
    return keypoints[pair.first][first], keypoints[pair.second][second]


def _count(votes: list[Int[Tensor, " _"]], pair: Pair, weight: int) -> None:
    for view, features in zip((pair.first, pair.second), pair.matches.unbind(dim=1), strict=True):
        votes[view] = votes[view].index_add(0, features, torch.full_like(features, weight))
