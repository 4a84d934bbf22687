"""Values of guessed maps where views observe points of the cloud."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.ground.geometry.projection import project
from pimper_torch.records import MapPrior, Record, SparseScene


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class AtPoints(Record):
    """Observations of points in views that have a map.

    Attributes:
        place: Map, row and column: the pixel of the map that shows the point.
        pixels: Of the undistorted photograph.
        depth: Of the point, along the camera's axis.
    """

    point: Int[Tensor, " observation"]
    view: Int[Tensor, " observation"]
    place: Int[Tensor, "observation 3"]
    pixels: Float[Tensor, "observation 2"]
    depth: Float[Tensor, " observation"]


def at_points(
    prior: MapPrior, known: Bool[Tensor, "map height width"], scene: SparseScene
) -> AtPoints:
    """Find where maps of undistorted photographs show the points that their views observe.

    Args:
        known: Pixels at which the maps say something; others are left out.
    """
    point, view = scene.observation_point, scene.observation_view
    poses, intrinsics = scene.cameras.cam_from_world[view], scene.cameras.intrinsics[view]
    pixels, depth = project(scene.points_world[point, None], poses, intrinsics)
    pixels, depth = pixels[:, 0], depth[:, 0]
    place, within = places(prior, scene, view, pixels)
    within &= known[place.unbind(dim=-1)] & (depth > 0)
    return AtPoints(point=point, view=view, place=place, pixels=pixels, depth=depth).take(within)


def places(
    prior: MapPrior,
    scene: SparseScene,
    view: Int[Tensor, " pixel"],
    pixels: Float[Tensor, "pixel 2"],
) -> tuple[Int[Tensor, "pixel 3"], Bool[Tensor, " pixel"]]:
    """Return map, row and column of pixels of undistorted photographs, and which are in a map."""
    number = {name: index for index, name in enumerate(prior.names)}
    maps = torch.tensor([number.get(name, -1) for name in scene.views.names]).to(view)[view]
    sizes = prior.sizes_px[maps]
    inside = (pixels >= 0) & (pixels < scene.cameras.sizes_px[view])
    column_row = (pixels / scene.cameras.sizes_px[view] * sizes).nan_to_num(-1).long()
    column_row = torch.minimum(column_row.clamp_min(0), sizes - 1)
    return torch.cat([maps[:, None], column_row.flip(-1)], dim=1), inside.all(dim=-1) & (maps >= 0)


def means_by(
    values: Float[Tensor, "*row observation"], group: Int[Tensor, " observation"]
) -> Float[Tensor, "*row group"]:
    """Average over the observations of each group that has some."""
    _, own, count = torch.unique(group, return_inverse=True, return_counts=True)
    sums = values.new_zeros(*values.shape[:-1], len(count)).index_add(-1, own, values)
    return sums / count
