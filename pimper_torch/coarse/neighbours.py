"""Which views to match a view with, and where in depth to look."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.coarse.matching import Pairing
from pimper_torch.geometry.projection import project
from pimper_torch.records import Cameras, SparseScene

# Angles between rays that match well: below about 5 degrees depth is poorly told, above
# about 25 the windows look different. The centre and the widths of a bell round it.
_BEST_ANGLE_DEG = 12.0
_BELOW_DEG = 4.0
_ABOVE_DEG = 12.0


def choose_sources(
    scene: SparseScene, points: Int[Tensor, " chosen"], view: int, count: int
) -> Int[Tensor, " source"]:
    """Choose the views to match a view with by shared points and the angles at them.

    Args:
        scene: Cameras and tracks.
        points: Trusted ones.
        view: That is matched.
        count: At most so many.

    Returns:
        The best first; fewer than ``count`` if the others share nothing.
    """
    observed = scene.observed[points]
    here = observed[:, view]
    points_world, shared = scene.points_world[points[here]], observed[here]
    rays = normalize(points_world[:, None] - scene.cameras.centers_world, dim=-1)
    angle = torch.rad2deg((rays * rays[:, view, None]).sum(dim=-1).clamp(-1, 1).acos())
    width = torch.where(angle < _BEST_ANGLE_DEG, _BELOW_DEG, _ABOVE_DEG)
    value = torch.exp(-((angle - _BEST_ANGLE_DEG) / width).square() / 2)
    score = (value * shared).sum(dim=0)
    score[view] = 0
    order = score.argsort(descending=True)[:count]
    return order[score[order] > 0]


def inverse_depths(
    points_world: Float[Tensor, "point 3"], cameras: Cameras, view: int
) -> tuple[Float[Tensor, "point 2"], Float[Tensor, " point"], Bool[Tensor, " point"]]:
    """Give points' pixels and inverse depths in a view, and whether they lie in its picture."""
    pixels, depth = project(points_world, cameras.cam_from_world[view], cameras.intrinsics[view])
    within = ((pixels > 0) & (pixels < cameras.sizes_px[view])).all(dim=1) & (depth > 0)
    return pixels, 1 / torch.where(depth > 0, depth, 1), within


def step_for_one_pixel(
    pairing: Pairing,
    pixels: Float[Tensor, "point 2"],
    inverse_depth: Float[Tensor, " point"],
) -> float:
    """Give the change of inverse depth that moves points by one pixel in the sources.

    The median over points and sources: cameras round an object have about the same base.
    """
    height, width = pairing.ray.shape[-2:]
    column = pixels[:, 0].long().clamp(0, width - 1)
    row = pixels[:, 1].long().clamp(0, height - 1)
    ray = pairing.ray[:, :, row, column]
    change = 0.01 * inverse_depth.median()
    places = []
    for q in (inverse_depth - change, inverse_depth + change):
        at = ray + pairing.shift[:, :, None] * q
        places.append(at[:, :2] / at[:, 2:].clamp_min(1e-6))
    moved = (places[1] - places[0]).norm(dim=1).median()
    return float(2 * change / moved.clamp_min(1e-6))
