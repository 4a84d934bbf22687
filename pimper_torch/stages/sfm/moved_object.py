"""Capture sessions between which the object was moved, detected from matches.

If the object is turned over so that its underside shows, the object and its surroundings are two
rigid bodies: in a pair with one photograph of each session, no epipolar geometry explains the
matches of both. In a pair of one session one geometry does. Pairs of the first kind separate
features of the object from those of the surroundings, and show which photographs cannot be of one
session. Between sessions, only the object's own features link photographs.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.geometry.colmap_library import loaded, quiet
from pimper_torch.records import Record
from pimper_torch.records.sparse_model import SparseModel, select_views
from pimper_torch.runtime.errors import caution, some
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.stages.sfm import matching
from pimper_torch.stages.sfm.diagnose import FEWEST_VIEWS, JOINING, agreement, pairs_in
from pimper_torch.stages.sfm.epipolar import violating
from pimper_torch.stages.sfm.matching import Keypoints, Matches, PhotographPair, Rows
from pimper_torch.stages.sfm.reconstruct_config import MIN_MATCHES, ReconstructConfig

# Least matches of a second body in a pair, and their least fraction of the matches outside the
# first geometry. In rigid scenes up to 25 matches and 0.85 of those outside fit a second geometry
# by chance; in 24 pairs of a mug that was turned over 31 to 341, and 0.84 to 1.00.
_MIN_SECOND, _MIN_FRACTION = 30, 0.7
# More matches of a pair give no more information.
_ENOUGH = 50


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class MovedObject(Record):
    """Capture sessions between which the object was moved.

    Attributes:
        sessions: Number of each photograph's session; the first photograph's is 0.
        tying: The object's matches of every pair between two sessions that shows enough of it; they
            are the pair's first or second body.
        dropped: Pairs between two sessions whose geometry is that of the surroundings.
        around: Matches of the surroundings, within sessions and between.
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

    Of the two rigid bodies, the object is the one nearer to the centre of the photographs.

    Args:
        verified: Inliers of each pair's geometry.
        outside: Outliers of the same pairs.
    """
    one_session = MovedObject(sessions=torch.zeros(len(keypoints), dtype=torch.long))
    frequent = {pair: rows for pair, rows in outside.items() if len(rows) >= _MIN_SECOND}
    seconds = {}
    for pair, second in verify(frequent).items():
        if len(second) >= max(_MIN_SECOND, _MIN_FRACTION * len(frequent[pair])):
            far = violating(keypoints, pair, verified[pair], second, max_error_px)
            if max(float(x.double().mean()) for x in far) > 0.2:  # no geometry explains both
                seconds[pair] = second
    if len(seconds) < 3:  # a thing that was moved between two photographs is in few
        return one_session
    votes = object_votes(keypoints, sizes_px, verified, seconds)
    sessions = sessions_of(len(keypoints), verified, seconds, votes)
    if int(sessions.max()) == 0:
        return one_session
    object_matches, others, around = {}, {}, {}
    for pair, rows in verified.items():
        second = seconds.get(pair, rows[:0])
        if sessions[pair[0]] != sessions[pair[1]]:
            counts = _counts(votes, pair, rows)
            if pair in seconds:
                object_matches[pair] = second if counts[0] <= counts[1] else rows
            elif counts[0] <= counts[1]:  # otherwise the pair stays unchanged
                cast = [votes[view][outside[pair][:, side]] for side, view in enumerate(pair)]
                others[pair] = outside[pair][torch.stack(cast).amin(dim=0) >= 0]
        both = torch.cat([rows, second])
        around[pair] = both[_total(votes, pair, both) < 0]
    object_matches |= verify(others)
    tying = {pair: rows for pair, rows in object_matches.items() if len(rows) >= MIN_MATCHES}
    dropped = tuple(pair for pair in object_matches if pair not in tying)
    return MovedObject(sessions=sessions, tying=tying, dropped=dropped, around=around)


def object_votes(
    keypoints: Keypoints, sizes_px: Float[Tensor, "view 2"], verified: Matches, seconds: Matches
) -> list[Float[Tensor, " _"]]:
    """Return votes on each feature: positive for the object, negative for the surroundings.

    Matched features are on one body, and so are those of one geometry in a pair with two.
    """
    votes = [  # 1 at the centre, 0 at half a side from it
        1 - 2 * ((pixels - size / 2) / size).norm(dim=1)
        for pixels, size in zip(keypoints, sizes_px.to(keypoints[0]), strict=True)
    ]
    for _ in range(4):
        cast = [torch.zeros_like(vote) for vote in votes]
        for pair, second in seconds.items():
            sets = verified[pair], second
            means = [_total(votes, pair, rows).mean() for rows in sets]
            first = 1.0 if means[0] > means[1] else -1.0
            for rows, sign in zip(sets, (first, -first), strict=True):
                matching.add_votes(cast, pair, rows, torch.full((len(rows), 2), sign))
        votes = [vote.sign() for vote in cast]
    for _ in range(4):
        passed = [vote.clone() for vote in votes]
        for pair, rows in (*verified.items(), *seconds.items()):
            ends = [votes[view][rows[:, side]] for side, view in enumerate(pair)]
            matching.add_votes(passed, pair, rows, torch.stack(ends[::-1], dim=1))
        votes = [vote.sign() for vote in passed]
    return votes


def sessions_of(
    num_views: int, verified: Matches, seconds: Matches, votes: Sequence[Float[Tensor, " _"]]
) -> Int[Tensor, " view"]:
    """Return the session of every photograph.

    Correlation clustering: pairs in which one geometry explains features of both bodies attract,
    pairs that show two bodies repel, and other matched pairs attract weakly.

    Source: greedy additive edge contraction of Keuper et al., Efficient Decomposition of Image and
    Mesh Graphs by Lifted Multicuts, ICCV 2015.
    """
    weight = torch.zeros(num_views, num_views, dtype=torch.float64)
    for pair, rows in verified.items():
        smaller, total = min(_counts(votes, pair, rows)), sum(_counts(votes, pair, rows))
        if pair in seconds:
            weight[pair] = -min(len(seconds[pair]), _ENOUGH)
        elif smaller >= max(8, 0.1 * total):
            weight[pair] = min(smaller, _ENOUGH)
        else:
            weight[pair] = 0.001 * len(rows)  # these may be of one body alone
    return correlation_clustering(weight + weight.mT)


def correlation_clustering(weight: Float[Tensor, "view view"]) -> Int[Tensor, " view"]:
    """Merge the two groups that attract most until all repel; number groups by first member."""
    weight = weight.clone()
    group = torch.arange(len(weight))
    while True:
        weight.fill_diagonal_(0)
        kept, merged = sorted(divmod(int(weight.argmax()), len(weight)))
        if float(weight[kept, merged]) <= 0:
            return torch.unique(group, return_inverse=True)[1]
        group[group == merged] = kept
        weight[kept] += weight[merged]
        weight[:, kept] += weight[:, merged]
        weight[merged] = weight[:, merged] = 0


def _total(votes: Sequence[Tensor], pair: PhotographPair, rows: Rows) -> Float[Tensor, " match"]:
    return votes[pair[0]][rows[:, 0]] + votes[pair[1]][rows[:, 1]]


def _counts(votes: Sequence[Tensor], pair: PhotographPair, rows: Rows) -> tuple[int, int]:
    """Return the number of a pair's matches on the object, and on the surroundings."""
    total = _total(votes, pair, rows)
    return int((total > 0).sum()), int((total < 0).sum())


def link_sessions(database: Path, settings: ReconstructConfig) -> tuple[matching.VerifiedPair, ...]:
    """Find capture sessions, and keep only the object's matches between them.

    Args:
        database: With features, matches and verified pairs. Unchanged if nothing was moved.

    Returns:
        Matches of the surroundings, within sessions and between; empty if nothing was moved.
    """
    with quiet(), loaded().Database.open(database) as stored:
        verifier = matching.read_verifier(stored, settings)
        verified = matching.read_verified(stored, verifier.ids)
        outside = {
            pair: verifier.pairs[pair][~matching.among(verifier.pairs[pair], rows)]
            for pair, rows in verified.items()
        }
        sizes = torch.tensor([(camera.width, camera.height) for camera in verifier.cameras]).float()
        moved = find_moved_object(
            verifier.keypoints, sizes, verified, outside, verifier, settings.max_error_px
        )
        for pair, rows in moved.tying.items():
            if not torch.equal(rows, verified[pair]):
                ids = verifier.ids[pair[0]], verifier.ids[pair[1]]
                stored.update_two_view_geometry(*ids, verifier.geometries[pair])
        for pair in moved.dropped:
            stored.delete_two_view_geometry(verifier.ids[pair[0]], verifier.ids[pair[1]])
    return tuple(matching.pairs_of(verifier.keypoints, moved.around))


def sessions_in(
    model: SparseModel, names: Sequence[str], around: Sequence[matching.VerifiedPair]
) -> Int[Tensor, " view"]:
    """Return the session of each of a model's views, from matches around the object.

    In the object's frame, matches of the surroundings agree with the cameras within a session and
    contradict them between sessions. Groups without contradictions are joined by shared points; one
    or two views without any evidence are a group of their own.

    Args:
        around: Matches of the surroundings, with numbers of photographs.
    """
    weight = torch.zeros(model.num_views, model.num_views, dtype=torch.float64)
    for pair in pairs_in(model, names, around):
        votes = (2 * agreement(model, pair, 4.0) - 1) * min(pair.num_matches, _ENOUGH)
        weight[pair.views] = weight[pair.views[::-1]] = votes
    group = correlation_clustering(weight)
    member = torch.nn.functional.one_hot(group).double()
    points = model.observed.double() @ member
    small = member.sum(dim=0) < FEWEST_VIEWS
    apart = (member.mT @ weight @ member < 0) | small | small[:, None]
    return correlation_clustering(torch.where(apart, -torch.inf, points.mT @ points))[group]


def with_sessions(
    model: SparseModel, numbers: Int[Tensor, " view"], names: Sequence[str]
) -> SparseModel:
    """Return the model with the sessions of its views, and warn about the consequences.

    Views of a session with hardly any view in the model are removed, as little but the object links
    them to the others. If no session has more than two views, all stay and the warning asks for
    masks: the background shifted while the object turned, such as with a touched tripod.
    """
    small = torch.bincount(numbers)[numbers] < FEWEST_VIEWS
    if bool(small.all()):
        caution(
            "The background shifts relative to the object from photograph to photograph, so only "
            "the object's features are matched, and less exactly. Give masks of the object "
            "(`--masks`); they are not needed if the tripod is not touched.",
            stacklevel=4,
        )
        return model
    leave_out("sfm.small_sessions", small, names=model.names)
    if bool(small.any()):
        model, numbers = select_views(model, (~small).nonzero()[:, 0].tolist()), numbers[~small]
    groups = [
        [name for name, n in zip(model.names, numbers.tolist(), strict=True) if n == number]
        for number in sorted(set(numbers.tolist()))
    ]
    if len(groups) > 1:
        listed = "; ".join(f"{len(group)} ({some(group)})" for group in groups)
        caution(
            f"The object was moved on its support between {len(groups)} capture sessions: {listed}"
            ". Between sessions only the object's features are matched; all cameras are in the "
            "object's frame.",
            stacklevel=4,
        )
        return model.replace(sessions=numbers)
    if apart := [name for name in names if name not in model.names]:
        caution(
            f"The object was moved on its support, and too few of its features link {len(apart)} "
            f"of {len(names)} photographs to the others. Only the others are reconstructed, "
            f"without {some(apart, most=20)}. {JOINING}",
            stacklevel=4,
        )
    return model
