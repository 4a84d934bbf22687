"""Values of guessed maps where views observe points of the cloud."""

from collections.abc import Iterator
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
        known: Pixels with a value; observations at others are left out.
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


def layouts(prior: MapPrior, scene: SparseScene) -> Iterator[tuple[str, Int[Tensor, " map"]]]:
    """List how maps may be turned against their photographs, as numbers of EXIF."""
    tags, count = scene.views.orientations, len(prior.names)
    if tags is not None:
        own = tags[[scene.views.names.index(name) for name in prior.names]]
        if bool((own != 1).any()):
            yield "of the pixels that files store, before EXIF turns these", own
    yield "mirrored left to right", torch.full((count,), 2)
    yield "mirrored top to bottom", torch.full((count,), 4)


def turned(
    place: Int[Tensor, "pixel 3"], prior: MapPrior, orientations: Int[Tensor, " map"]
) -> Int[Tensor, "pixel 3"]:
    """Return the pixels that come to places when maps are turned as EXIF says."""
    tag, last = orientations.to(place)[place[:, 0]], prior.sizes_px[place[:, 0]].to(place) - 1
    mirrored, flipped = _flips(tag)
    row = torch.where(flipped, last[:, 1] - place[:, 1], place[:, 1])
    column = torch.where(mirrored, last[:, 0] - place[:, 2], place[:, 2])
    across = tag >= 5  # of square maps: others are refused where they are read
    found = torch.where(across, column, row), torch.where(across, row, column)
    return torch.stack([place[:, 0], found[0].minimum(last[:, 1]), found[1].minimum(last[:, 0])], 1)


def turned_vectors(
    vectors: Float[Tensor, "pixel 3"], orientations: Int[Tensor, " pixel"]
) -> Float[Tensor, "pixel 3"]:
    """Turn vectors, in axes x right, y down, like the pixels of maps that EXIF turns."""
    tag = orientations[:, None]
    found = torch.where(tag >= 5, vectors[:, [1, 0, 2]], vectors)
    signs = [1 - 2 * flips.to(vectors) for flips in _flips(tag)]
    return found * torch.cat([*signs, torch.ones_like(signs[0])], dim=-1)


def _flips(
    tag: Int[Tensor, "*place"],
) -> tuple[Bool[Tensor, "*place"], Bool[Tensor, "*place"]]:
    """Return whether EXIF exchanges left and right, and top and bottom, after rows and columns."""
    return (tag % 4 == 2) | (tag % 4 == 3), (tag == 3) | (tag == 4) | (tag >= 7)


def means_by(
    values: Float[Tensor, "*row observation"], group: Int[Tensor, " observation"]
) -> Float[Tensor, "*row group"]:
    """Average over the observations of each group that has some."""
    _, own, count = torch.unique(group, return_inverse=True, return_counts=True)
    sums = values.new_zeros(*values.shape[:-1], len(count)).index_add(-1, own, values)
    return sums / count
