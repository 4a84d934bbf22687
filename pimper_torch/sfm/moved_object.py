"""An object that was moved on its table between two series of photographs, found in their matches.

Turned over so that its underside shows, the object and what surrounds it are two rigid bodies: in a
pair of photographs with one of each series, no epipolar geometry explains the matches of both. In a
pair of one series one geometry does. Pairs of the first kind tell features of the object from those
of the surroundings, and which photographs cannot be of one series; between series, only what is the
object's ties photographs together.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.records import Record
from pimper_torch.sfm.matching import PhotographPair
from pimper_torch.sfm.static_background import Ends, Keypoints, sampson_errors, shared_geometry

# Matches of the second body below which a pair does not show two bodies, and the fraction of the
# matches outside the first geometry that they must be. In rigid scenes up to 25 matches and 0.85
# of those outside fit a second geometry by chance; in 24 pairs of a mug that was turned over 31 to
# 341, and 0.84 to 1.00.
_MIN_SECOND, _MIN_FRACTION = 30, 0.7
# Fraction of a body's matches that must violate the geometry of both.
_VIOLATING = 0.2
# Pairs that must show two bodies; a thing that a person moved between two photographs shows in few.
_MIN_PAIRS = 3
# Rounds in which neighbours hand on what they are.
_ROUNDS = 4
# Features of each body in one geometry that make a pair one of the same series, and their fraction.
_MIN_BOTH, _MIN_BOTH_FRACTION = 8, 0.1
# Matches beyond which a pair tells no more, and weight of matches that may be of one body alone.
_ENOUGH, _OTHERWISE = 50, 0.001

Rows = Int[Tensor, "match 2"]
Verify = Callable[[Mapping[PhotographPair, Rows]], Mapping[PhotographPair, Rows]]
"""Those of each pair's matches that one epipolar geometry explains."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class MovedObject(Record):
    """Series of photographs between which the object was moved.

    Attributes:
        series: Number of each photograph's; the first photograph's is 0.
        tying: Of every pair between two series that shows enough of the object, the object's
            matches; they are the pair's first or second body.
        dropped: Pairs between two series whose geometry is that of the surroundings.
        around: Matches of the surroundings, within series and between.
    """

    series: Int[Tensor, " view"]
    tying: Mapping[PhotographPair, Rows] = field(default_factory=dict)
    dropped: tuple[PhotographPair, ...] = ()
    around: Mapping[PhotographPair, Rows] = field(default_factory=dict)

    @property
    def moved(self) -> bool:
        """True where there is more than one series."""
        return bool((self.series > 0).any())


def find_moved_object(
    keypoints: Keypoints,
    sizes_px: Float[Tensor, "view 2"],
    verified: Mapping[PhotographPair, Rows],
    outside: Mapping[PhotographPair, Rows],
    verify: Verify,
    *,
    max_error_px: float,
    fewest: int,
) -> MovedObject:
    """Report photographs of two or more series apart, and what ties them together.

    Of the two bodies the object is the one nearer to the middle of the photographs.

    Args:
        verified: Matches of each pair that its geometry explains.
        outside: Matches of the same pairs that it does not.
        max_error_px: Distance from the epipolar line up to which a match is verified.
        fewest: Matches below which a pair does not count.
    """
    whole = MovedObject(series=torch.zeros(len(keypoints), dtype=torch.long))
    many = {pair: rows for pair, rows in outside.items() if len(rows) >= _MIN_SECOND}
    seconds = {
        pair: second
        for pair, second in verify(many).items()
        if len(second) >= max(_MIN_SECOND, _MIN_FRACTION * len(many[pair]))
        and _contradict(keypoints, pair, verified[pair], second, max_error_px)
    }
    if len(seconds) < _MIN_PAIRS:
        return whole
    votes = object_votes(keypoints, sizes_px, verified, seconds)
    series = series_of(len(keypoints), verified, seconds, votes)
    if int(series.max()) == 0:
        return whole
    own, around_it = {}, {}
    for pair, rows in verified.items():
        if series[pair[0]] != series[pair[1]]:
            counts = _counts(votes, pair, rows)
            if counts[0] <= counts[1]:
                around_it[pair] = _perhaps_own(votes, pair, outside[pair])
            elif pair in seconds:
                own[pair] = rows  # without a second geometry it stays as it is
    own |= verify({pair: rows for pair, rows in around_it.items() if pair not in seconds})
    own |= {pair: seconds[pair] for pair in around_it if pair in seconds}
    tying = {pair: rows for pair, rows in own.items() if len(rows) >= fewest}
    dropped = [pair for pair in own if pair not in tying]
    around = {
        pair: _surroundings(votes, pair, torch.cat([rows, seconds.get(pair, rows[:0])]))
        for pair, rows in verified.items()
    }
    return MovedObject(series=series, tying=tying, dropped=tuple(dropped), around=around)


def object_votes(
    keypoints: Keypoints,
    sizes_px: Float[Tensor, "view 2"],
    verified: Mapping[PhotographPair, Rows],
    seconds: Mapping[PhotographPair, Rows],
) -> list[Float[Tensor, " _"]]:
    """Return how sure each feature is the object's: above 0 it is, below 0 of the surroundings.

    Features that match are of one body, and so are those of one geometry in a pair that has two.
    """
    inside = [
        1 - 2 * ((pixels - size / 2) / size).norm(dim=1)
        for pixels, size in zip(keypoints, sizes_px.to(keypoints[0]), strict=True)
    ]
    votes = inside  # how central: 1 in the middle, 0 half a side from it
    for _ in range(_ROUNDS):
        cast = [torch.zeros_like(one) for one in inside]
        for pair, second in seconds.items():
            sets = verified[pair], second
            first_is = _mean(votes, pair, sets[0]) > _mean(votes, pair, sets[1])
            for rows, sign in zip(sets, (1.0, -1.0) if first_is else (-1.0, 1.0), strict=True):
                _add(cast, pair, rows, torch.full((len(rows), 2), sign))
        votes = [one.sign() for one in cast]
    for _ in range(_ROUNDS):
        handed = [one.clone() for one in votes]
        for pair, rows in (*verified.items(), *seconds.items()):
            ends = [votes[view][rows[:, side]] for side, view in enumerate(pair)]
            _add(handed, pair, rows, torch.stack(ends[::-1], dim=1))
        votes = [one.sign() for one in handed]
    return votes


def series_of(
    num_views: int,
    verified: Mapping[PhotographPair, Rows],
    seconds: Mapping[PhotographPair, Rows],
    votes: Sequence[Float[Tensor, " _"]],
) -> Int[Tensor, " view"]:
    """Number the series of every photograph.

    Correlation clustering: pairs in which one geometry explains features of both bodies attract,
    pairs that show two bodies repel, and pairs that match otherwise attract where nothing else
    tells.

    Source: greedy additive edge contraction of Keuper et al., Efficient Decomposition of Image and
    Mesh Graphs by Lifted Multicuts, ICCV 2015.
    """
    weight = torch.zeros(num_views, num_views, dtype=torch.float64)
    for pair, rows in verified.items():
        both, total = min(_counts(votes, pair, rows)), sum(_counts(votes, pair, rows))
        if pair in seconds:
            weight[pair] = -min(len(seconds[pair]), _ENOUGH)
        elif both >= max(_MIN_BOTH, _MIN_BOTH_FRACTION * total):
            weight[pair] = min(both, _ENOUGH)
        else:
            weight[pair] = _OTHERWISE * len(rows)
    return clusters(weight + weight.mT)


def clusters(weight: Float[Tensor, "view view"]) -> Int[Tensor, " view"]:
    """Merge the two groups that attract most until all repel; number groups by first members."""
    weight = weight.clone()
    group = torch.arange(len(weight))
    while True:
        weight.fill_diagonal_(0)
        best = int(weight.argmax())
        kept, gone = sorted(divmod(best, len(weight)))
        if float(weight[kept, gone]) <= 0:
            return torch.unique(group, return_inverse=True)[1]
        group[group == gone] = kept
        weight[kept] += weight[gone]
        weight[:, kept] += weight[:, gone]
        weight[gone] = weight[:, gone] = 0


def _perhaps_own(votes: Sequence[Tensor], pair: PhotographPair, rows: Rows) -> Rows:
    first, second = (votes[view][rows[:, side]] for side, view in enumerate(pair))
    return rows[(first >= 0) & (second >= 0)]


def _contradict(
    keypoints: Keypoints, pair: PhotographPair, first: Rows, second: Rows, max_error_px: float
) -> bool:
    """Return whether no geometry explains both sets of matches."""

    def ends(rows: Rows) -> Ends:
        return keypoints[pair[0]][rows[:, 0]], keypoints[pair[1]][rows[:, 1]]

    shared = shared_geometry(ends(first), ends(second), max_error_px)
    far = [
        (sampson_errors(shared, *ends(rows)) > max_error_px).double().mean()
        for rows in (first, second)
    ]
    return float(torch.stack(far).amax()) > _VIOLATING


def _mean(votes: Sequence[Tensor], pair: PhotographPair, rows: Rows) -> float:
    first, second = (votes[view][rows[:, side]] for side, view in enumerate(pair))
    return float((first + second).mean())


def _counts(votes: Sequence[Tensor], pair: PhotographPair, rows: Rows) -> tuple[int, int]:
    """Count a pair's matches that are of the object, and of the surroundings."""
    first, second = (votes[view][rows[:, side]] for side, view in enumerate(pair))
    total = first + second
    return int((total > 0).sum()), int((total < 0).sum())


def _surroundings(votes: Sequence[Tensor], pair: PhotographPair, rows: Rows) -> Rows:
    first, second = (votes[view][rows[:, side]] for side, view in enumerate(pair))
    return rows[first + second < 0]


def _add(
    votes: Sequence[Tensor], pair: PhotographPair, rows: Rows, cast: Float[Tensor, "match 2"]
) -> None:
    for side, view in enumerate(pair):
        votes[view].index_add_(0, rows[:, side], cast[:, side].to(votes[view]))
