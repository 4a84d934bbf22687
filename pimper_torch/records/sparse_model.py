"""A sparse model without photographs: the result of SfM, and the content of COLMAP folders."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.records import CameraModel, Record, pairs_table
from pimper_torch.records.scene import no_maps, no_sessions
from pimper_torch.records.shapes import Points
from pimper_torch.runtime.ledger import leave_out


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SparseModel(Record):
    """Registered views and their sparse points, in float64 on the CPU.

    Attributes:
        lenses: One per view, before undistortion.
        observation_pixels: In the photograph before undistortion.
        background_from_view: Maps from pixels of each photograph, before undistortion, to the frame
            in which the background of a turning object is static; NaN for a view that shows too
            little of it. Empty without such a background.
        sessions: Number of each view's capture session, if the object was moved between sessions;
            otherwise empty.
    """

    names: tuple[str, ...]
    lenses: tuple[CameraModel, ...]
    cam_from_world: Float[Tensor, "view 4 4"]
    points_world: Points = field(default_factory=lambda: no_maps()[:, 0].double())
    observation_point: Int[Tensor, " observation"] = field(default_factory=no_sessions)
    observation_view: Int[Tensor, " observation"] = field(default_factory=no_sessions)
    observation_pixels: Float[Tensor, "observation 2"] = field(
        default_factory=lambda: no_maps()[:, 0, :2].double()
    )
    background_from_view: Float[Tensor, "mapped 3 3"] = field(default_factory=no_maps)
    sessions: Int[Tensor, " divided"] = field(default_factory=no_sessions)

    @property
    def num_views(self) -> int:
        """Number of registered views."""
        return len(self.names)

    @property
    def observed(self) -> Bool[Tensor, "point view"]:
        """True where a view observes a point."""
        shape = len(self.points_world), self.num_views
        return pairs_table(self.observation_point, self.observation_view, shape)

    def with_points(self, other: "SparseModel") -> "SparseModel":
        """Replace points and observations by those of a model of the same views."""
        return self.replace(
            points_world=other.points_world,
            observation_point=other.observation_point,
            observation_view=other.observation_view,
            observation_pixels=other.observation_pixels,
        )

    def joined(self, other: "SparseModel") -> "SparseModel":
        """Add points and observations of a model of the same views."""
        shifted = other.observation_point + len(self.points_world)
        return self.replace(
            points_world=torch.cat([self.points_world, other.points_world]),
            observation_point=torch.cat([self.observation_point, shifted]),
            observation_view=torch.cat([self.observation_view, other.observation_view]),
            observation_pixels=torch.cat([self.observation_pixels, other.observation_pixels]),
        )

    def without(self, observations: Bool[Tensor, " observation"]) -> "SparseModel":
        """Remove observations, and points with fewer than two remaining ones."""
        kept = self.replace(
            observation_point=self.observation_point[~observations],
            observation_view=self.observation_view[~observations],
            observation_pixels=self.observation_pixels[~observations],
        )
        return select_views(kept, range(self.num_views))


def select_views(model: SparseModel, chosen: Sequence[int]) -> SparseModel:
    """Select views of a model, in the given order, and the points observed by at least two of them.

    Returns:
        Points in their old order. Observations are sorted by point, then view.
    """
    views = torch.tensor(chosen, dtype=torch.long)
    counts = torch.bincount(model.observation_view, minlength=model.num_views)
    by_view = torch.split(torch.argsort(model.observation_view, stable=True), counts.tolist())
    rows = torch.cat([views[:0], *(by_view[view] for view in chosen)])
    view = torch.arange(len(chosen)).repeat_interleave(counts[views])
    point = model.observation_point[rows]
    shared = pairs_table(point, view, (len(model.points_world), len(chosen))).sum(dim=1) >= 2
    rows, view, point = (values[shared[point]] for values in (rows, view, point))
    point = (torch.cumsum(shared, dim=0) - 1)[point]
    order = torch.argsort(point * max(len(chosen), 1) + view, stable=True)
    maps, sessions = model.background_from_view, model.sessions
    return SparseModel(
        names=tuple(model.names[index] for index in chosen),
        lenses=tuple(model.lenses[index] for index in chosen),
        cam_from_world=model.cam_from_world[views],
        points_world=model.points_world[shared],
        observation_point=point[order],
        observation_view=view[order],
        observation_pixels=model.observation_pixels[rows[order]],
        background_from_view=maps[views] if len(maps) else maps,
        sessions=sessions[views] if len(sessions) else sessions,
    )


def drop_weak_views(model: SparseModel, fewest: int) -> SparseModel:
    """Remove views with too few points for a reliable pose, until all have enough."""
    while model.num_views:
        counts = torch.bincount(model.observation_view, minlength=model.num_views)
        strong = torch.nonzero(counts >= fewest)[:, 0].tolist()
        leave_out("sfm.weak_views", counts < fewest)
        if len(strong) == model.num_views:
            break
        model = select_views(model, strong)
    return model


def longest_tracks(model: SparseModel, most: int) -> SparseModel:
    """Keep each view's points with the longest tracks, with all their observations.

    Args:
        most: Points per view; more if other views select them.
    """
    length = torch.bincount(model.observation_point)[model.observation_point]
    order = torch.argsort(length, descending=True, stable=True)
    order = order[torch.argsort(model.observation_view[order], stable=True)]
    view = model.observation_view[order]
    rank = torch.arange(len(order)) - torch.searchsorted(view, view)
    wanted = torch.zeros(len(model.points_world), dtype=torch.bool)
    wanted[model.observation_point[order[rank < most]]] = True
    return model.without(~wanted[model.observation_point])
