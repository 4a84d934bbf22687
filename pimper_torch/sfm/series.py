"""What becomes of a model of several series of photographs, between which the object was moved."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.errors import caution, some
from pimper_torch.geometry.frames import invert_rigid
from pimper_torch.geometry.supporting_plane import PlaneSearch, fixation, supporting_plane
from pimper_torch.ledger import leave_out
from pimper_torch.sfm.agreement import agreement
from pimper_torch.sfm.components import FEWEST_VIEWS, JOINING
from pimper_torch.sfm.matching import VerifiedPair
from pimper_torch.sfm.model import SparseModel, select_views
from pimper_torch.sfm.moved_object import clusters

# Points of the object: this far above the plane in tolerances, as near to the fixation point in
# distances of the cameras, and seen by as many views (as silhouettes/cloud.py has it).
_CLEAR, _NEAR, _MIN_TRACK = 1.5, 0.6, 3
# Views from directions as near as this see the same side of the object. If both see enough points
# of it, at most this fraction of the smaller number in common, it is not where it was. In right
# models such views share 0.6 and more.
_SAME_SIDE_DEG, _MIN_SEEN, _SHARED = 25.0, 15, 0.02
# Pairs of such views without which nothing is said; points beyond which a pair tells no more; and
# weight of points of the surroundings that two views share.
_MIN_PAIRS, _ENOUGH, _OTHERWISE = 3, 50, 0.001
# Distance from the cameras' epipolar line up to which a match agrees: twice what verifies it.
_AGREEING_PX = 4.0


def series_in(
    model: SparseModel, names: Sequence[str], around: Sequence[VerifiedPair]
) -> Int[Tensor, " view"]:
    """Number the series of a model's views, by what they show round the object.

    In the object's frame, matches of the surroundings agree with the cameras within a series, and
    contradict them between two. Groups that nothing contradicts are joined by the points that they
    share; a view or two of which nothing is known are a group of their own.

    Args:
        model: In the object's frame; of all photographs or some.
        names: Of all photographs.
        around: Matches of the surroundings, with numbers of photographs.
    """
    view_of = {names.index(name): view for view, name in enumerate(model.names)}
    weight = torch.zeros(model.num_views, model.num_views, dtype=torch.float64)
    for pair in around:
        if all(number in view_of for number in pair.views):
            first, second = (view_of[number] for number in pair.views)
            fraction = agreement(model, pair.replace(views=(first, second)), _AGREEING_PX)
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
    the others.

    Args:
        model: In the object's frame; of all photographs or some.
        numbers: Of its views' series.
        names: Of all photographs.
    """
    kept = torch.nonzero(torch.bincount(numbers)[numbers] >= FEWEST_VIEWS)[:, 0]
    small = torch.bincount(numbers)[numbers] < FEWEST_VIEWS
    leave_out("sfm.small_series", small, names=model.names)
    if len(kept) < model.num_views:
        model, numbers = select_views(model, kept.tolist()), numbers[kept]
    count = len(set(numbers.tolist()))
    if count < 2:
        apart = [name for name in names if name not in model.names]
        if apart:
            caution(apart_message(len(names), apart), stacklevel=4)
        return model
    caution(
        f"The object was moved on what it stands on, between {count} series of "
        f"photographs: {_listed(model.names, numbers)}. Between them only the object's features "
        "are matched, and the cameras of all stand round the object.",
        stacklevel=4,
    )
    return model.replace(series=numbers)


def largest_series(model: SparseModel) -> SparseModel:
    """Keep the largest series of a model in which the object stands at several places.

    Args:
        model: Registered on what the object stands on. Without such series it stays as it is.
    """
    series = series_apart(model)
    leave_out("sfm.series_apart", series != torch.bincount(series).argmax(), names=model.names)
    if int(series.max()) == 0:
        return model
    largest = int(torch.bincount(series).argmax())
    apart = [name for name, one in zip(model.names, series.tolist(), strict=True) if one != largest]
    caution(apart_message(model.num_views, apart), stacklevel=4)
    return select_views(model, torch.nonzero(series == largest)[:, 0].tolist())


def apart_message(num_views: int, apart: Sequence[str]) -> str:
    """Say which photographs stand apart, and what would join them."""
    return (
        f"The object was moved on what it stands on, and too little of it ties {len(apart)} of "
        f"{num_views} photographs to the others, which are reconstructed alone; apart stand "
        f"{some(apart, most=20)}. {JOINING}"
    )


def series_apart(model: SparseModel) -> Int[Tensor, " view"]:
    """Number the series of views in which the object stands at different places.

    Views from the same side share points of the object, unless it was moved between them.

    Returns:
        0 for all views where it was not, or where too little tells.
    """
    whole = torch.zeros(model.num_views, dtype=torch.long)
    on_object = object_points(model)
    if on_object is None:
        return whole
    focus = fixation(model.cam_from_world).fixation_world
    seen = model.observed[on_object].double()
    shared = seen.mT @ seen
    fewer = torch.minimum(shared.diagonal()[:, None], shared.diagonal())
    away = torch.nn.functional.normalize(_eyes(model) - focus, dim=1)
    near = (away @ away.mT).clamp(-1, 1).acos().rad2deg() < _SAME_SIDE_DEG
    repel = near & (fewer >= _MIN_SEEN) & (shared <= _SHARED * fewer)
    if int(repel.sum()) < 2 * _MIN_PAIRS:
        return whole
    others = model.observed[~on_object].double()
    weight = shared.clamp_max(_ENOUGH) + _OTHERWISE * (others.mT @ others)
    found = clusters(torch.where(repel, -fewer.clamp_max(_ENOUGH), weight))
    count = torch.bincount(found)
    return found if int((count >= FEWEST_VIEWS).sum()) > 1 else whole


def object_points(model: SparseModel) -> Bool[Tensor, " point"] | None:
    """Mark the points that stand above the supporting plane; ``None`` without one."""
    points, search = model.points_world, PlaneSearch()
    focus = fixation(model.cam_from_world)
    tracked = model.observed.sum(dim=1) >= _MIN_TRACK
    plane = supporting_plane(points[tracked], _eyes(model), float(focus.distance), search)
    if plane is None:
        return None
    height = plane.height_of(points)
    away = (points - focus.fixation_world).norm(dim=1)
    clear = height > _CLEAR * search.tolerance * focus.distance
    return tracked & clear & (away < _NEAR * focus.distance)


def _eyes(model: SparseModel) -> Float[Tensor, "view 3"]:
    return invert_rigid(model.cam_from_world)[:, :3, 3]


def _listed(names: Sequence[str], series: Int[Tensor, " view"]) -> str:
    groups = [
        [name for name, one in zip(names, series.tolist(), strict=True) if one == number]
        for number in sorted(set(series.tolist()))
    ]
    return "; ".join(f"{len(group)} ({some(group)})" for group in groups)
