"""Which points of the cloud are the object's."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.geometry.projection import project
from pimper_torch.geometry.supporting_plane import Fixation, Plane, well_tracked
from pimper_torch.records import Cameras, Record, SparseScene

_CLEAR = 1.5  # tolerances above the plane: nearer points may lie on it
_NEAR = 0.6  # of the cameras' distance: an object that fills photographs of 60 degrees
# Without a plane: this quantile of the distances to the fixation point, and what beyond it is
# the object's, and certainly is not.
_CENTRE, _WITHIN, _OUTSIDE = 0.7, 1.3, 2.6


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SplitCloud(Record):
    """The cloud's points, divided into object and background.

    Attributes:
        background: Certainly not the object's; the remainder may be either.
    """

    on_object: Bool[Tensor, " point"]
    background: Bool[Tensor, " point"]


def split_cloud(
    scene: SparseScene,
    fixation: Fixation,
    plane: Plane | None,
    tolerance: float,
    box_world: Float[Tensor, "2 3"] | None,
) -> SplitCloud:
    """Divide the cloud into points of the object and of the background.

    With a plane they are what stands above it near the fixation point, without one what is near
    that point.

    Args:
        tolerance: Of the plane, scene units.
        box_world: What is outside is not the object.
    """
    points, tracked = scene.points_world, well_tracked(scene)
    away = (points - fixation.fixation_world).norm(dim=1)
    if plane is None:
        centre = torch.quantile(away[tracked], _CENTRE) if bool(tracked.any()) else away.sum()
        on_object = away < _WITHIN * centre
        background = away > _OUTSIDE * centre
    else:
        on_object = (plane.height_of(points) > _CLEAR * tolerance) & (
            away < _NEAR * fixation.distance
        )
        background = ~on_object
    if box_world is not None:
        low, high = box_world.to(points)
        inside = ((points >= low) & (points <= high)).all(dim=1)
        on_object, background = on_object & inside, background | ~inside
    return SplitCloud(on_object=tracked & on_object, background=tracked & background)


def pixels_seen(
    scene: SparseScene, cameras: Cameras, chosen: Bool[Tensor, " point"]
) -> list[Float[Tensor, "_ 2"]]:
    """Return where each view shows those of the chosen points that it observes."""
    points = scene.points_world.cpu().float()
    pixels, _ = project(points, cameras.cam_from_world, cameras.intrinsics)
    seen = (scene.observed & chosen[:, None]).cpu()
    return [pixels[view, seen[:, view]] for view in range(cameras.num_views)]


def pixels_of(
    scene: SparseScene, cameras: Cameras, chosen: Bool[Tensor, " point"]
) -> list[Float[Tensor, "_ 2"]]:
    """Return where the chosen points are in each view, whether or not it observes them.

    A point of the object is inside its silhouette also where another part hides it.
    """
    points = scene.points_world.cpu().float()[chosen.cpu()]
    pixels, _ = project(points, cameras.cam_from_world, cameras.intrinsics)
    sizes = cameras.sizes_px.to(pixels)[:, None]
    within = ((pixels > 0) & (pixels < sizes)).all(dim=-1)
    return [pixels[view, within[view]] for view in range(cameras.num_views)]
