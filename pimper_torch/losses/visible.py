"""Vertices that cameras see, and values of images there."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from pimper_torch.geometry.pixels import grid_from_pixels
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.visibility import ray_caster
from pimper_torch.records import Cameras, Surface
from pimper_torch.records.shapes import Points

Visible = Bool[Tensor, "view vertex"]

# Distance in front of a vertex, over the surface's diagonal, within which it does not occlude it.
_TOLERANCE = 0.005


@torch.no_grad()
def visible_vertices(surface: Surface, cameras: Cameras, min_cosine: float = 0.4) -> Visible:
    """Return which vertices the photographs determine, and each camera sees unoccluded.

    A discrete choice: compute it once, and pass it to the losses of all steps.

    Args:
        min_cosine: Least cosine between the normal and the direction to the camera.
    """
    points, caster = surface.vertices_world, ray_caster(surface.mesh)
    size = (points.amax(dim=0) - points.amin(dim=0)).norm()
    rows = []
    for view, center in enumerate(cameras.centers_world.to(points)):
        towards = normalize(center - points, dim=1)
        pixels, depth = in_view(points, cameras, view)
        seen = surface.supported & ((towards * surface.normals_world).sum(dim=1) > min_cosine)
        seen &= ((pixels > 0) & (pixels < cameras.sizes_px[view])).all(dim=1) & (depth > 0)
        rows.append(seen & ~caster.occluded(points, center, float(_TOLERANCE * size)))
    return torch.stack(rows)


def in_view(
    points_world: Points, cameras: Cameras, view: int
) -> tuple[Float[Tensor, "point 2"], Float[Tensor, " point"]]:
    """Project points into one view; see :func:`~pimper_torch.geometry.projection.project`."""
    camera = cameras.cam_from_world[view], cameras.intrinsics[view]
    return project(points_world, *(matrix.to(points_world) for matrix in camera))


def interpolated_at(
    image: Float[Tensor, "channel height width"], pixels: Float[Tensor, "point 2"]
) -> Float[Tensor, "point channel"]:
    """Interpolate an image bilinearly at pixels; differentiable in both."""
    grid = grid_from_pixels(pixels.to(image), image.shape[-1], image.shape[-2])
    values = grid_sample(image[None], grid[None, None], padding_mode="border", align_corners=False)
    return values[0, :, 0].mT
