"""Reprojection errors of points."""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.geometry.rigid import transform
from pimper_torch.sfm import colmap
from pimper_torch.sfm.model import SparseModel


def observation_errors(model: SparseModel) -> Float[Tensor, " observation"]:
    """Return the distance between where a point is seen and where it should be, in pixels.

    Infinite for a point that a camera sees from behind.
    """
    residual = torch.full_like(model.observation_pixels[:, 0], torch.inf)
    for index, lens in enumerate(model.lenses):
        here = torch.nonzero(model.observation_view == index)[:, 0]
        points = model.points_world[model.observation_point[here]]
        expected = colmap.distort(lens, transform(model.cam_from_world[index], points))
        distance = (expected - model.observation_pixels[here]).norm(dim=-1)
        residual[here] = distance.nan_to_num(nan=torch.inf)
    return residual


def reprojection_errors(model: SparseModel) -> Float[Tensor, " point"]:
    """Average :func:`observation_errors` over each point's track."""
    total = torch.zeros_like(model.points_world[:, 0])
    total = total.index_add(0, model.observation_point, observation_errors(model))
    count = torch.bincount(model.observation_point, minlength=len(total))
    return total / count.clamp_min(1)
