"""Some of the views or points of a scene."""

from typing import NamedTuple

from jaxtyping import Bool, Int
from torch import Tensor

from pimper_torch.records import SparseScene


def with_views(scene: SparseScene, kept: Bool[Tensor, " view"]) -> SparseScene:
    """Keep some of the views, and what these observe; the others count as not registered."""
    index = kept.nonzero()[:, 0].tolist()
    observed = kept.to(scene.observation_view.device)[scene.observation_view]
    number = kept.long().cumsum(dim=0).to(scene.observation_view.device) - 1
    maps, series, names = scene.background_from_view, scene.series, scene.views.names
    left_out = tuple(name for name, keep in zip(names, kept.tolist(), strict=True) if not keep)
    return scene.replace(
        views=scene.views.take(index),
        cameras=scene.cameras.take(index),
        observation_point=scene.observation_point[observed],
        observation_view=number[scene.observation_view[observed]],
        observation_pixels=scene.observation_pixels[observed],
        lenses=tuple(scene.lenses[view] for view in index) if scene.lenses else (),
        unregistered=(*scene.unregistered, *left_out),
        background_from_view=maps[kept.to(maps.device)] if len(maps) else maps,
        series=series[kept.to(series.device)] if len(series) else series,
    )


def with_points(scene: SparseScene, kept: Bool[Tensor, " point"]) -> SparseScene:
    """Keep some of the points, and where they were observed."""
    observed = kept[scene.observation_point]
    number = kept.long().cumsum(dim=0) - 1
    return scene.replace(
        points_world=scene.points_world[kept],
        reprojection_errors_px=scene.reprojection_errors_px[kept],
        observation_point=number[scene.observation_point[observed]],
        observation_view=scene.observation_view[observed],
        observation_pixels=scene.observation_pixels[observed],
    )


class OneAPose(NamedTuple):
    """A scene with one photograph of every pose.

    Attributes:
        scene: Those photographs alone, with what all of their poses observe.
        of: Which of them has the pose of each view of the whole scene.
    """

    scene: SparseScene
    chosen: Int[Tensor, " pose"]
    of: Int[Tensor, " view"]
