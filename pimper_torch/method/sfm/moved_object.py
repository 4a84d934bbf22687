"""An object that was moved on its table between two series of photographs, found in their matches.

Turned over so that its underside shows, the object and what surrounds it are two rigid bodies: in a
pair of photographs with one of each series, no epipolar geometry explains the matches of both. In a
pair of one series one geometry does. Pairs of the first kind separate features of the object from
those of the surroundings, and show which photographs cannot be of one series; between series, only
the object's own features tie photographs together.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.ground.geometry.colmap_library import loaded, quiet
from pimper_torch.method.sfm import matching
from pimper_torch.method.sfm.diagnose import FEWEST_VIEWS, JOINING, agreement
from pimper_torch.method.sfm.epipolar import sampson_errors, shared_geometry
from pimper_torch.method.sfm.matching import Keypoints, Matches, PhotographPair, Rows
from pimper_torch.method.sfm.model import SparseModel, select_views
from pimper_torch.method.sfm.reconstruct_config import MIN_MATCHES, ReconstructConfig
from pimper_torch.records import Record
from pimper_torch.runtime.errors import caution, some
from pimper_torch.runtime.ledger import leave_out

# Matches of the second body below which a pair does not show two bodies, and the fraction of the
# matches outside the first geometry that they must be. In rigid scenes up to 25 matches and 0.85
# of those outside fit a second geometry by chance; in 24 pairs of a mug that was turned over 31 to
# 341, and 0.84 to 1.00.
_MIN_SECOND, _MIN_FRACTION = 30, 0.7
# Matches beyond which a pair gives no more information.
_ENOUGH = 50


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

    sessions: Int[Tensor, " view"]
    tying: Matches = field(default_factory=dict)
    dropped: tuple[PhotographPair, ...] = ()
    around: Matches = field(default_factory=dict)


def find_moved_object(
    keypoints: Keypoints,
    sizes_px: Float[Tensor, "view 2"],
    verified: Matches,
    outside: Matches,
    verify: matching.Verify,
    max_error_px: float,
) -> MovedObject:
    """Divide the photographs into capture sessions, linked by matches of the object.

    Of the two rigid parts the object is the one nearer to the middle of the photographs.

    Args:
        verified: Matches of each pair that its geometry explains.
        outside: Matches of the same pairs that it does not.
    """
    whole = MovedObject(sessions=torch.zeros(len(keypoints), dtype=torch.long))
    many = {pair: rows for pair, rows in outside.items() if len(rows) >= _MIN_SECOND}
    seconds = {}
    for pair, second in verify(many).items():
        if len(second) >= max(_MIN_SECOND, _MIN_FRACTION * len(many[pair])):
            ends = [matching.pixels_of(keypoints, pair, rows) for rows in (verified[pair], second)]
            shared = shared_geometry(ends[0], ends[1], max_error_px)
            far = [(sampson_errors(shared, *each) > max_error_px).double().mean() for each in ends]
            if float(torch.stack(far).amax()) > 0.2:  # no geometry explains both
                seconds[pair] = second
    if len(seconds) < 3:  # a thing that a person moved between two photographs shows in few
        return whole
    votes = object_votes(keypoints, sizes_px, verified, seconds)
    sessions = sessions_of(len(keypoints), verified, seconds, votes)
    if int(sessions.max()) == 0:
        return whole
    own, around_it = {}, {}
    for pair, rows in verified.items():
        if sessions[pair[0]] != sessions[pair[1]]:
            counts = _counts(votes, pair, rows)
            if counts[0] <= counts[1]:
                cast = [votes[view][outside[pair][:, side]] for side, view in enumerate(pair)]
                around_it[pair] = outside[pair][torch.stack(cast).amin(dim=0) >= 0]
            elif pair in seconds:
                own[pair] = rows  # without a second geometry it stays as it is
    own |= verify({pair: rows for pair, rows in around_it.items() if pair not in seconds})
    own |= {pair: seconds[pair] for pair in around_it if pair in seconds}
    tying = {pair: rows for pair, rows in own.items() if len(rows) >= MIN_MATCHES}
    dropped = [pair for pair in own if pair not in tying]
    every = {
        pair: torch.cat([rows, seconds.get(pair, rows[:0])]) for pair, rows in verified.items()
    }
    around = {pair: rows[_total(votes, pair, rows) < 0] for pair, rows in every.items()}
    return MovedObject(sessions=sessions, tying=tying, dropped=tuple(dropped), around=around)


def object_votes(
    keypoints: Keypoints, sizes_px: Float[Tensor, "view 2"], verified: Matches, seconds: Matches
) -> list[Float[Tensor, " _"]]:
    """Return how sure each feature is the object's: above 0 it is, below 0 of the surroundings.

    Features that match are of one body, and so are those of one geometry in a pair that has two.
    """
    votes = [  # how central: 1 in the middle, 0 half a side from it
        1 - 2 * ((pixels - size / 2) / size).norm(dim=1)
        for pixels, size in zip(keypoints, sizes_px.to(keypoints[0]), strict=True)
    ]
    for _ in range(4):
        cast = [torch.zeros_like(one) for one in votes]
        for pair, second in seconds.items():
            sets = verified[pair], second
            means = [_total(votes, pair, rows).mean() for rows in sets]
            first = 1.0 if means[0] > means[1] else -1.0
            for rows, sign in zip(sets, (first, -first), strict=True):
                matching.add_votes(cast, pair, rows, torch.full((len(rows), 2), sign))
        votes = [one.sign() for one in cast]
    for _ in range(4):
        handed = [one.clone() for one in votes]
        for pair, rows in (*verified.items(), *seconds.items()):
            ends = [votes[view][rows[:, side]] for side, view in enumerate(pair)]
            matching.add_votes(handed, pair, rows, torch.stack(ends[::-1], dim=1))
        votes = [one.sign() for one in handed]
    return votes


def sessions_of(
    num_views: int, verified: Matches, seconds: Matches, votes: Sequence[Float[Tensor, " _"]]
) -> Int[Tensor, " view"]:
    """Number the series of every photograph.

    Correlation clustering: pairs in which one geometry explains features of both bodies attract,
    pairs that show two bodies repel, and pairs that match otherwise attract where nothing else
    decides.

    Source: greedy additive edge contraction of Keuper et al., Efficient Decomposition of Image and
    Mesh Graphs by Lifted Multicuts, ICCV 2015.
    """
    weight = torch.zeros(num_views, num_views, dtype=torch.float64)
    for pair, rows in verified.items():
        both, total = min(_counts(votes, pair, rows)), sum(_counts(votes, pair, rows))
        if pair in seconds:
            weight[pair] = -min(len(seconds[pair]), _ENOUGH)
        elif both >= max(8, 0.1 * total):
            weight[pair] = min(both, _ENOUGH)
        else:
            weight[pair] = 0.001 * len(rows)  # these may be of one body alone
    return clusters(weight + weight.mT)


def clusters(weight: Float[Tensor, "view view"]) -> Int[Tensor, " view"]:
    """Merge the two groups that attract most until all repel; number groups by first members."""
    weight = weight.clone()
    group = torch.arange(len(weight))
    while True:
        weight.fill_diagonal_(0)
        kept, gone = sorted(divmod(int(weight.argmax()), len(weight)))
        if float(weight[kept, gone]) <= 0:
            return torch.unique(group, return_inverse=True)[1]
        group[group == gone] = kept
        weight[kept] += weight[gone]
        weight[:, kept] += weight[:, gone]
        weight[gone] = weight[:, gone] = 0


def _total(votes: Sequence[Tensor], pair: PhotographPair, rows: Rows) -> Float[Tensor, " match"]:
    return votes[pair[0]][rows[:, 0]] + votes[pair[1]][rows[:, 1]]


def _counts(votes: Sequence[Tensor], pair: PhotographPair, rows: Rows) -> tuple[int, int]:
    """Count a pair's matches that are of the object, and of the surroundings."""
    total = _total(votes, pair, rows)
    return int((total > 0).sum()), int((total < 0).sum())


def link_sessions(database: Path, settings: ReconstructConfig) -> tuple[matching.VerifiedPair, ...]:
    """Find series between which the object was moved, and keep between them what is the object's.

    Args:
        database: With features, matches and verified pairs. Where nothing was moved it stays as it
            is.

    Returns:
        Matches of the surroundings, within series and between; none where nothing was moved.
    """
    with quiet(), loaded().Database.open(database) as stored:
        matched = matching.read_matched(stored)
        geometries = {
            pair: geometry
            for pair, geometry in matching.read_geometries(stored, matched.ids).items()
            if len(geometry.inlier_matches) >= MIN_MATCHES
        }
        verified = {pair: matching.indices(one.inlier_matches) for pair, one in geometries.items()}
        outside = {
            pair: rows[~matching.among(rows, verified[pair])]
            for pair, rows in matched.pairs.items()
            if pair in verified
        }
        verifier = matching.Verifier(matched=matched, settings=settings)
        found = find_moved_object(
            matched.keypoints,
            torch.tensor([(one.width, one.height) for one in matched.cameras]).float(),
            verified,
            outside,
            verifier,
            settings.max_error_px,
        )
        for pair, rows in found.tying.items():
            if not torch.equal(rows, verified[pair]):
                ids = matched.ids[pair[0]], matched.ids[pair[1]]
                stored.update_two_view_geometry(*ids, verifier.geometries[pair])
        for pair in found.dropped:
            stored.delete_two_view_geometry(matched.ids[pair[0]], matched.ids[pair[1]])
    return tuple(matching.pairs_of(matched.keypoints, found.around))


def series_in(
    model: SparseModel, names: Sequence[str], around: Sequence[matching.VerifiedPair]
) -> Int[Tensor, " view"]:
    """Number the series of a model's views, by what they show around the object.

    In the object's frame, matches of the surroundings agree with the cameras within a series, and
    contradict them between two. Groups that nothing contradicts are joined by the points that they
    share; a view or two of which nothing is known are a group of their own.

    Args:
        around: Matches of the surroundings, with numbers of photographs.
    """
    view_of = {names.index(name): view for view, name in enumerate(model.names)}
    weight = torch.zeros(model.num_views, model.num_views, dtype=torch.float64)
    for pair in around:
        if all(number in view_of for number in pair.views):
            first, second = (view_of[number] for number in pair.views)
            fraction = agreement(model, pair.replace(views=(first, second)), 4.0)
            votes = (2 * fraction - 1) * min(pair.num_matches, _ENOUGH)
            weight[first, second] = weight[second, first] = votes
    group = clusters(weight)
    member = torch.nn.functional.one_hot(group).double()
    seen = model.observed.double() @ member
    few = member.sum(dim=0) < FEWEST_VIEWS
    apart = (member.mT @ weight @ member < 0) | few | few[:, None]
    return clusters(torch.where(apart, -torch.inf, seen.mT @ seen))[group]


def with_series(
    model: SparseModel, numbers: Int[Tensor, " view"], names: Sequence[str]
) -> SparseModel:
    """Note which series the views of a model are of, and say what that means.

    Views of a series that is hardly in the model are left out: little but the object ties them to
    the others. Where no series has more than two views, all stay, and masks are asked for: a
    background shifted while the object turned, as where a tripod was touched.
    """
    small = torch.bincount(numbers)[numbers] < FEWEST_VIEWS
    if bool(small.all()):
        caution(
            "The background shifts against the object from photograph to photograph, so that only "
            "the object's features are matched, and these with errors. Give masks of the object "
            "(`--masks`); a tripod that is not touched needs none.",
            stacklevel=4,
        )
        return model
    leave_out("sfm.small_sessions", small, names=model.names)
    if bool(small.any()):
        model, numbers = select_views(model, (~small).nonzero()[:, 0].tolist()), numbers[~small]
    groups = [
        [name for name, its in zip(model.names, numbers.tolist(), strict=True) if its == number]
        for number in sorted(set(numbers.tolist()))
    ]
    if len(groups) > 1:
        listed = "; ".join(f"{len(group)} ({some(group)})" for group in groups)
        caution(
            f"The object was moved on what it stands on, between {len(groups)} series of "
            f"photographs: {listed}. Between them only the object's features are matched, and the "
            "cameras of all are around the object.",
            stacklevel=4,
        )
        return model.replace(sessions=numbers)
    if apart := [name for name in names if name not in model.names]:
        caution(
            f"The object was moved on what it stands on, and too little of it ties {len(apart)} of "
            f"{len(names)} photographs to the others, which are reconstructed alone; left out "
            f"are {some(apart, most=20)}. {JOINING}",
            stacklevel=4,
        )
    return model
