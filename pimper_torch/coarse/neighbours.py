"""Which views to match a view with, and the step of inverse depth that they resolve."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.coarse.matching import Pairing
from pimper_torch.records import SparseScene

# Angles between rays that match well: below about 5 degrees depth is poorly determined, above
# about 25 windows look different. Centre and standard deviations of a bell curve; a choice.
_BEST_ANGLE_DEG = 12.0
_BELOW_DEG = 4.0
_ABOVE_DEG = 12.0


def choose_sources(
    scene: SparseScene, points: Int[Tensor, " chosen"], view: int, count: int
) -> Int[Tensor, " source"]:
    """Choose the views to match a view with by shared points and the angles at them.

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


def step_for_one_pixel(
    pairing: Pairing,
    pixels: Float[Tensor, "point 2"],
    inverse_depth: Float[Tensor, " point"],
) -> float:
    """Return the change of inverse depth that moves points by one pixel in the sources.

    The median over points and sources: cameras round an object have about the same base.
    """
    height, width = pairing.ray.shape[-2:]
    column = pixels[:, 0].long().clamp(0, width - 1)
    row = pixels[:, 1].long().clamp(0, height - 1)
    there = pairing.replace(ray=pairing.ray[:, :, row, column])
    change = 0.01 * inverse_depth.median()
    before, after = (there.look(inverse_depth + sign * change)[0] for sign in (-1, 1))
    moved = (after - before).norm(dim=1).median()
    return float(2 * change / moved.clamp_min(1e-6))
