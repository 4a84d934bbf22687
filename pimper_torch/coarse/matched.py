"""The cloud that the coarse surface goes through: dense points, and sparse ones between them."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.coarse.densify import DensifyConfig, DepthMaps, depth_maps
from pimper_torch.coarse.oriented import (
    OrientedPoints,
    oriented_points,
    sparse_oriented,
    thinned,
    with_common_normals,
)
from pimper_torch.records import Cameras, SparseScene


def matched_cloud(
    scene: SparseScene,
    reliable: Int[Tensor, " reliable"],
    config: DensifyConfig,
    cell_px: float,
) -> tuple[OrientedPoints, DepthMaps, float]:
    """Match the photographs densely, and merge the depth maps and the sparse points.

    Args:
        cell_px: Of the cloud's finest grid, pixels of the finest depth maps.

    Returns:
        The cloud, the finest depth maps, and the size of their pixels there, scene units.
    """
    maps = depth_maps(scene, reliable, config)
    pixel = pixel_size(scene, reliable) * maps[-1].factor
    # The coarsest windows of three reach past contours: they only initialize the finer ones.
    dense = with_common_normals(thinned(oriented_points(maps[-2:]), cell_px * pixel))
    cloud = OrientedPoints.cat([dense, sparse_oriented(scene, reliable, dense, 3 * pixel)])
    return cloud, maps[-1], pixel


def pixel_size(scene: SparseScene, reliable: Int[Tensor, " reliable"]) -> float:
    """Return the size of a photograph's pixel at reliable points; the median over observations."""
    chosen = torch.isin(scene.observation_point, reliable)
    view, point = scene.observation_view[chosen], scene.observation_point[chosen]
    frames = scene.cameras.cam_from_world[view]
    depth = (frames[:, 2, :3] * scene.points_world[point]).sum(dim=-1) + frames[:, 2, 3]
    return float((depth / scene.cameras.intrinsics[view, 0, 0]).median())


def pixel_size_at(point: Float[Tensor, " 3"], cameras: Cameras) -> float:
    """Return the size of a photograph's pixel at a point; the median over views."""
    distance = (cameras.centers_world - point).norm(dim=1)
    return float((distance / cameras.intrinsics[:, 0, 0]).median())
