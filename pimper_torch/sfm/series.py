"""Models of several series of photographs, between which the object was moved."""

from collections.abc import Sequence

import torch
from jaxtyping import Int
from torch import Tensor

from pimper_torch.errors import caution, some
from pimper_torch.ledger import leave_out
from pimper_torch.sfm.agreement import agreement
from pimper_torch.sfm.components import FEWEST_VIEWS, JOINING
from pimper_torch.sfm.matching import VerifiedPair
from pimper_torch.sfm.model import SparseModel, select_views
from pimper_torch.sfm.moved_object import clusters

# Matches beyond which a pair tells no more.
_ENOUGH = 50
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
            caution(_apart_message(len(names), apart), stacklevel=4)
        return model
    caution(
        f"The object was moved on what it stands on, between {count} series of "
        f"photographs: {_listed(model.names, numbers)}. Between them only the object's features "
        "are matched, and the cameras of all stand round the object.",
        stacklevel=4,
    )
    return model.replace(series=numbers)


def _apart_message(num_views: int, apart: Sequence[str]) -> str:
    """State which photographs stand apart, and what would join them."""
    return (
        f"The object was moved on what it stands on, and too little of it ties {len(apart)} of "
        f"{num_views} photographs to the others, which are reconstructed alone; apart stand "
        f"{some(apart, most=20)}. {JOINING}"
    )


def _listed(names: Sequence[str], series: Int[Tensor, " view"]) -> str:
    groups = [
        [name for name, one in zip(names, series.tolist(), strict=True) if one == number]
        for number in sorted(set(series.tolist()))
    ]
    return "; ".join(f"{len(group)} ({some(group)})" for group in groups)
