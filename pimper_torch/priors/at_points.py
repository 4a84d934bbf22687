"""Pixels of prior maps at which views observe points of the cloud."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.geometry.projection import project
from pimper_torch.records import MapPrior, Record, SparseScene


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class AtPoints(Record):
    """Observations of points in views that have a map.

    Attributes:
        index: Map, row and column of the map's pixel at the point.
        pixels: In the undistorted photograph.
        depth: Of the point, along the camera's axis.
    """

    point: Int[Tensor, " observation"]
    view: Int[Tensor, " observation"]
    index: Int[Tensor, "observation 3"]
    pixels: Float[Tensor, "observation 2"]
    depth: Float[Tensor, " observation"]


def at_points(
    prior: MapPrior, valid: Bool[Tensor, "map height width"], scene: SparseScene
) -> AtPoints:
    """Return the observations of points in views with a map of the undistorted photograph.

    Args:
        valid: Pixels with a value; observations at other pixels are skipped.
    """
    point, view = scene.observation_point, scene.observation_view
    poses, intrinsics = scene.cameras.cam_from_world[view], scene.cameras.intrinsics[view]
    pixels, depth = project(scene.points_world[point, None], poses, intrinsics)
    pixels, depth = pixels[:, 0], depth[:, 0]
    index, within = map_indices(prior, scene, view, pixels)
    within &= valid[index.unbind(dim=-1)] & (depth > 0)
    return AtPoints(point=point, view=view, index=index, pixels=pixels, depth=depth).take(within)


def map_indices(
    prior: MapPrior,
    scene: SparseScene,
    view: Int[Tensor, " pixel"],
    pixels: Float[Tensor, "pixel 2"],
) -> tuple[Int[Tensor, "pixel 3"], Bool[Tensor, " pixel"]]:
    """Return map, row and column of pixels in undistorted photographs, and which are in a map."""
    map_of = {name: index for index, name in enumerate(prior.names)}
    maps = torch.tensor([map_of.get(name, -1) for name in scene.views.names]).to(view)[view]
    sizes = prior.sizes_px[maps]
    inside = (pixels >= 0) & (pixels < scene.cameras.sizes_px[view])
    column_row = (pixels / scene.cameras.sizes_px[view] * sizes).nan_to_num(-1).long()
    column_row = torch.minimum(column_row.clamp_min(0), sizes - 1)
    return torch.cat([maps[:, None], column_row.flip(-1)], dim=1), inside.all(dim=-1) & (maps >= 0)


def exif_errors(prior: MapPrior, scene: SparseScene) -> Iterator[tuple[str, Int[Tensor, " map"]]]:
    """List wrong orientations of maps, as EXIF orientations that correct them."""
    tags, count = scene.views.orientations, len(prior.names)
    if tags is not None:
        map_tags = tags[[scene.views.names.index(name) for name in prior.names]]
        if bool((map_tags != 1).any()):
            yield "for the pixels as stored, without EXIF's orientation", map_tags
    yield "mirrored left to right", torch.full((count,), 2)
    yield "mirrored top to bottom", torch.full((count,), 4)


def reoriented(
    index: Int[Tensor, "pixel 3"], prior: MapPrior, orientations: Int[Tensor, " map"]
) -> Int[Tensor, "pixel 3"]:
    """Return the index in the given map of each pixel of the map reoriented as EXIF says."""
    tag, last = orientations.to(index)[index[:, 0]], prior.sizes_px[index[:, 0]].to(index) - 1
    mirrored, flipped = _flips(tag)
    row = torch.where(flipped, last[:, 1] - index[:, 1], index[:, 1])
    column = torch.where(mirrored, last[:, 0] - index[:, 2], index[:, 2])
    transposed = tag >= 5  # only square maps: others are an error when they are read
    row, column = torch.where(transposed, column, row), torch.where(transposed, row, column)
    return torch.stack([index[:, 0], row.minimum(last[:, 1]), column.minimum(last[:, 0])], 1)


def reoriented_vectors(
    vectors: Float[Tensor, "pixel 3"], orientations: Int[Tensor, " pixel"]
) -> Float[Tensor, "pixel 3"]:
    """Reorient vectors, in axes x right, y down, with the pixels of their maps."""
    tag = orientations[:, None]
    transposed = torch.where(tag >= 5, vectors[:, [1, 0, 2]], vectors)
    signs = [1 - 2 * flips.to(vectors) for flips in _flips(tag)]
    return transposed * torch.cat([*signs, torch.ones_like(signs[0])], dim=-1)


def _flips(tag: Int[Tensor, "*pixel"]) -> tuple[Bool[Tensor, "*pixel"], Bool[Tensor, "*pixel"]]:
    """Return whether EXIF flips left and right, and top and bottom, after transposing."""
    return (tag % 4 == 2) | (tag % 4 == 3), (tag == 3) | (tag == 4) | (tag >= 7)


def means_by(
    values: Float[Tensor, "*row observation"], group: Int[Tensor, " observation"]
) -> Float[Tensor, "*row group"]:
    """Average over the observations of each group that occurs, in increasing order of groups."""
    _, row, count = torch.unique(group, return_inverse=True, return_counts=True)
    sums = values.new_zeros(*values.shape[:-1], len(count)).index_add(-1, row, values)
    return sums / count
