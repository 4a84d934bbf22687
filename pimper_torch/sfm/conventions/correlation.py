"""Squares of the photographs round the points of a model: what views of a point show alike.

A square lies on the plane across a point's mean viewing direction.
"""

from collections.abc import Collection

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample, normalize, one_hot

from pimper_torch.geometry.pixels import grid_from_pixels
from pimper_torch.geometry.rigid import transform
from pimper_torch.mapped import drop_pages
from pimper_torch.records import Views
from pimper_torch.sfm import colmap
from pimper_torch.sfm.model import SparseModel

# Samples to either side of a point, and pixels from one to the next.
_REACH, _STEP_PX = 3, 1.5


def correlations(
    model: SparseModel,
    views: Views,
    shifts: Float[Tensor, "way 2"] | None = None,
    moved: Collection[int] = (),
) -> tuple[Float[Tensor, "way observation"], Float[Tensor, "way observation"]]:
    """Correlate each observation's square with the mean of its point's others.

    Args:
        model: In the pixels of the views, in their order.
        shifts: Of some views, the way their squares are moved.
        moved: Numbers of these views.

    Returns:
        With the others of its own point, and of another point, as chance has it; 0 where a square
        tells nothing.
    """
    shifts = torch.zeros(1, 2) if shifts is None else shifts
    sides = _sides(model)
    squares = torch.zeros(len(shifts), len(sides), (2 * _REACH + 1) ** 2)
    for view, (width, height) in enumerate(views.sizes_px.tolist()):
        here = (model.observation_view == view).nonzero()[:, 0]
        picture = views.images[view, :, :height, :width]
        centers = model.observation_pixels[here] + (view in moved) * shifts[:, None]
        squares[:, here] = squares_in(picture, centers, sides[here][None])
        drop_pages()
    point = model.observation_point
    count = int(point.max()) + 1 if len(point) else 0
    sums = squares.new_zeros(len(shifts), count, squares.shape[-1]).index_add(-2, point, squares)
    others = normalize(sums[..., point, :] - squares, dim=-1)
    strangers = normalize(sums, dim=-1)[..., point - 1, :]
    return (squares * others).sum(dim=-1), (squares * strangers).sum(dim=-1)


def _sides(model: SparseModel) -> Float[Tensor, "observation 2 2"]:
    """Compute the sides of each observation's square, a step long, in pixels."""
    axes = _axes(model)
    sides = model.points_world.new_empty(len(model.observation_view), 2, 2)
    for view, lens in enumerate(model.lenses):
        here = model.observation_view == view
        points = model.observation_point[here]
        ends = torch.cat([model.points_world[points, None], axes[points]], dim=1)
        rays = transform(model.cam_from_world[view], ends.reshape(-1, 3))
        pixels = colmap.distort(lens, rays).reshape(-1, 3, 2)
        sides[here] = pixels[:, 1:] - pixels[:, :1]
    return sides


def squares_in(
    picture: Float[Tensor, "channel height width"],
    centers: Float[Tensor, "*way observation 2"],
    sides: Float[Tensor, "*#way observation 2 2"],
) -> Float[Tensor, "*way observation sample"]:
    """Sample squares along two sides, without their mean and with unit length.

    Args:
        centers: Pixels of the picture.
        sides: In its pixels.

    Returns:
        Float32; zero where a square reaches beyond the picture or shows nothing.
    """
    height, width = picture.shape[1:]
    along = torch.arange(-_REACH, _REACH + 1, dtype=centers.dtype)
    raster = torch.cartesian_prod(along, along)
    grid = grid_from_pixels(centers[..., None, :] + raster @ sides, width, height)
    places = grid.reshape(1, 1, -1, 2).to(picture)
    found = grid_sample(picture[None].detach(), places, align_corners=False)[0, :, 0].mean(dim=0)
    found = found.cpu().clamp_min(0).sqrt().reshape(grid.shape[:-1])
    inside = ((grid.abs() <= 1).all(dim=-1)).all(dim=-1, keepdim=True)  # false for NaN
    found = torch.where(inside, found, 0)
    patterns = found - found.mean(dim=-1, keepdim=True)
    told = patterns.norm(dim=-1, keepdim=True) > 1e-3 * found.norm(dim=-1, keepdim=True)
    return torch.where(told, normalize(patterns, dim=-1), 0).float()


def _axes(model: SparseModel) -> Float[Tensor, "point 2 3"]:
    """Return, of each point, the ends of two steps across its mean viewing direction.

    On average over its views a step is as long as samples are apart in the photographs.
    """
    point, view = model.observation_point, model.observation_view
    pose = model.cam_from_world[view]
    points = model.points_world[point]
    depth = (pose[:, 2, :3] * points).sum(dim=1) + pose[:, 2, 3]
    centers = -(pose[:, :3, :3].mT @ pose[:, :3, 3:])[..., 0]
    towards = normalize(points - centers, dim=1)
    count = len(model.points_world)
    mean = towards.new_zeros(count, 3).index_add(0, point, towards)
    focal = torch.stack([colmap.pinhole_of(lens)[0, 0] for lens in model.lenses])
    length = towards.new_zeros(count).index_add(0, point, depth.abs() / focal[view])
    length = length / torch.bincount(point, minlength=count).clamp_min(1)
    mean = normalize(mean, dim=1)
    least = one_hot(mean.abs().argmin(dim=1), 3).to(mean)
    first = normalize(torch.linalg.cross(mean, least), dim=1)
    second = torch.linalg.cross(mean, first)
    steps = _STEP_PX * length[:, None, None] * torch.stack([first, second], dim=1)
    return model.points_world[:, None] + steps
