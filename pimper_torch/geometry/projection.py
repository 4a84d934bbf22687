"""Pinhole projection: points to pixels, pixels to rays, rays to points."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.pixels import homogeneous
from pimper_torch.geometry.rigid import transform
from pimper_torch.records import Cameras
from pimper_torch.records.shapes import Points, ViewVectors

_POINTS = 2048  # in a block: 72 MB of angles between the rays of 66 views


def project(
    points_world: Float[Tensor, "*#batch point 3"],
    cam_from_world: Float[Tensor, "*#batch 4 4"],
    intrinsics: Float[Tensor, "*#batch 3 3"],
) -> tuple[Float[Tensor, "*batch point 2"], Float[Tensor, "*batch point"]]:
    """Project points into an image.

    Returns:
        Pixels, and depth along the camera's z. Pixels of points behind the camera (depth <= 0) are
        meaningless; the caller masks them. Differentiable where depth is not 0.
    """
    points_cam = transform(cam_from_world, points_world)
    depth = points_cam[..., 2]
    scaled = points_cam @ intrinsics.mT
    safe = torch.where(depth.abs() > torch.finfo(depth.dtype).tiny, depth, 1)
    return scaled[..., :2] / safe[..., None], depth


def rays_through(
    pixels: Float[Tensor, "*#batch pixel 2"],
    cam_from_world: Float[Tensor, "*#batch 4 4"],
    intrinsics: Float[Tensor, "*#batch 3 3"],
) -> Float[Tensor, "*batch pixel 3"]:
    """Return the world direction of the ray through each pixel.

    Not unit: ``center + depth * ray`` is the point at that depth along the camera's z.
    """
    rays_cam = torch.linalg.solve(intrinsics, homogeneous(pixels).mT).mT
    return rays_cam @ cam_from_world[..., :3, :3]


def triangulate_rays(
    cameras: Cameras, pixels: Float[Tensor, "point view 2"], seen: Bool[Tensor, "point view"]
) -> Points:
    """Triangulate points: the nearest to their rays in the least-squares sense.

    Args:
        seen: Whether a view observes the point; at least two views with different centres do.
    """
    rays = rays_through(pixels.movedim(0, 1), cameras.cam_from_world, cameras.intrinsics)
    rays = (rays / rays.norm(dim=-1, keepdim=True)).movedim(0, 1)
    across = torch.eye(3).to(rays) - rays[..., :, None] * rays[..., None, :]
    across = across * seen[..., None, None]
    matrix = across.sum(dim=1)
    rhs = (across @ cameras.centers_world[..., None]).sum(dim=1)
    return torch.linalg.solve(matrix, rhs)[..., 0]


def triangulation_angles(
    points_world: Points, observed: Bool[Tensor, "point view"], centers_world: ViewVectors
) -> Float[Tensor, " point"]:
    """Return the largest angle between two rays of each point, radians; 0 with fewer than two."""
    count = observed.sum(dim=1)
    largest = torch.zeros_like(points_world[:, 0])
    for block in torch.split(count.argsort(stable=True), _POINTS):
        longest = max(count[block].tolist(), default=0)
        if longest < 2:
            continue
        seen, views = observed[block].byte().topk(longest, dim=1)
        rays = normalize(points_world[block, None] - centers_world[views], dim=-1)
        observed_pair = (seen[:, :, None] * seen[:, None, :]).bool()
        cosines = torch.where(observed_pair, rays @ rays.mT, 1).flatten(1).amin(dim=1)
        largest[block] = cosines.clamp(-1, 1).acos()
    return largest
