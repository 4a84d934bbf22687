"""Squares of the photographs round the points of a model: what views of a point show alike.

A square lies on the plane across a point's mean viewing direction. It is correlated with the mean
of those of the point's other views.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, normalize, one_hot

from pimper_torch.geometry.pixels import grid_from_pixels
from pimper_torch.geometry.rigid import transform
from pimper_torch.mapped import drop_pages
from pimper_torch.records import Views
from pimper_torch.sfm import colmap
from pimper_torch.sfm.model import SparseModel

# Samples to either side of a point, and pixels from one to the next: choices.
_REACH, _STEP_PX = 3, 1.5
SAMPLES = (2 * _REACH + 1) ** 2
"""Of a square."""


def others_of(
    own: Float[Tensor, "*way observation sample"], point: Int[Tensor, " observation"]
) -> tuple[Float[Tensor, "*way observation sample"], Float[Tensor, "*way observation sample"]]:
    """Average the squares of each observation's point without its own, and those of another point.

    Returns:
        Of unit length, or zero.
    """
    count = int(point.max()) + 1 if len(point) else 0
    sums = own.new_zeros(*own.shape[:-2], count, own.shape[-1]).index_add(-2, point, own)
    others = normalize(sums[..., point, :] - own, dim=-1)
    return others, normalize(sums, dim=-1)[..., point - 1, :]


def sampled(
    model: SparseModel,
    views: Views,
    ways: Callable[
        [int, Float[Tensor, "own 2"], Float[Tensor, "own 2 2"]],
        tuple[Float[Tensor, "way own 2"], Float[Tensor, "#way own 2 2"]],
    ],
    count: int,
) -> Float[Tensor, "{count} observation sample"]:
    """Sample the square round each observation in several ways, see :func:`squares_in`.

    Args:
        views: The model's, in its order; resized, or turned by quarters.
        ways: Centres and sides of a view's squares, by its number, its observations as the model
            has them, and their sides in pixels of the photograph.
    """
    sides = _sides(model, views)
    squares = torch.zeros(count, len(sides), SAMPLES)
    for view, (width, height) in enumerate(views.sizes_px.tolist()):
        here = (model.observation_view == view).nonzero()[:, 0]
        picture = views.images[view, :, :height, :width]
        places = ways(view, model.observation_pixels[here], sides[here])
        squares[:, here] = squares_in(picture, *places)
        drop_pages()
    return squares


def _sides(model: SparseModel, views: Views) -> Float[Tensor, "observation 2 2"]:
    """Compute the sides of each observation's square, a step long, in pixels of the photographs."""
    axes = _axes(model, views)
    sides = model.points_world.new_empty(len(model.observation_view), 2, 2)
    for view, lens in enumerate(model.lenses):
        here = model.observation_view == view
        points = model.observation_point[here]
        ends = torch.cat([model.points_world[points, None], axes[points]], dim=1)
        rays = transform(model.cam_from_world[view], ends.reshape(-1, 3))
        pixels = colmap.distort(lens, rays).reshape(-1, 3, 2)
        scale = max(views.sizes_px[view].tolist()) / max(lens.width, lens.height)
        sides[here] = (pixels[:, 1:] - pixels[:, :1]) * scale
    return sides


def squares_in(
    picture: Float[Tensor, "channel height width"],
    centers: Float[Tensor, "*way observation 2"],
    sides: Float[Tensor, "*#way observation 2 2"],
) -> Float[Tensor, "*way observation sample"]:
    """Sample squares along two sides, without their mean and with unit length.

    Args:
        centers: Pixels of it.
        sides: In pixels of it, turned as it is.

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


def _axes(model: SparseModel, views: Views) -> Float[Tensor, "point 2 3"]:
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
    focal = torch.stack(
        [
            colmap.pinhole_of(lens)[0, 0] * max(size) / max(lens.width, lens.height)
            for lens, size in zip(model.lenses, views.sizes_px.tolist(), strict=True)
        ]
    )
    length = towards.new_zeros(count).index_add(0, point, depth.abs() / focal[view])
    length = length / torch.bincount(point, minlength=count).clamp_min(1)
    mean = normalize(mean, dim=1)
    least = one_hot(mean.abs().argmin(dim=1), 3).to(mean)
    first = normalize(torch.linalg.cross(mean, least), dim=1)
    second = torch.linalg.cross(mean, first)
    steps = _STEP_PX * length[:, None, None] * torch.stack([first, second], dim=1)
    return model.points_world[:, None] + steps
