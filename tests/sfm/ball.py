"""Closed forms of a textured ball or wall seen from an arc, each view under its own light."""

import torch
from sparse_models import observed, views_of
from torch import Tensor

from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import rays_through
from pimper_torch.geometry.rigid import rigid
from pimper_torch.records import CameraModel, Cameras, Views
from pimper_torch.records.sparse_model import SparseModel

WIDTH, HEIGHT, FOCAL = 480, 360, 840.0

# Position of the wall, whose normal is the z axis.
WALL = -0.9


def cameras_on_an_arc(count: int = 6) -> Cameras:
    poses = []
    for angle in torch.linspace(-0.5, 0.5, count, dtype=torch.float64):
        tilt = 0.15 * torch.sin(7 * angle)
        rotation = torch.linalg.matrix_exp(
            torch.tensor([[0, 0.0, -angle], [0.0, 0, -tilt], [angle, tilt, 0]], dtype=torch.float64)
        )
        poses.append(rigid(rotation[None], torch.tensor([[0, 0, 5.0]], dtype=torch.float64))[0])
    K = torch.tensor(
        [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64
    )
    return Cameras(
        intrinsics=K.expand(count, 3, 3).clone(),
        cam_from_world=torch.stack(poses),
        sizes_px=torch.tensor([[WIDTH, HEIGHT]] * count),
    )


def albedo(points: Tensor) -> Tensor:
    waves = torch.tensor(
        [[38.0, 14, 6], [-16, 34, 10], [22, -26, 18], [54, 8, -42], [6, 58, 30], [-46, 18, 38]],
        dtype=torch.float64,
    )
    return torch.exp(0.35 * torch.sin(points @ waves.mT + torch.arange(6)).sum(dim=-1))


def photographs(cameras: Cameras, *, lit: bool = True, wall: bool = False) -> Views:
    """Render every view of the ball or wall; ``lit`` rotates the light from view to view."""
    pixels = pixel_centers(WIDTH, HEIGHT, like=cameras.intrinsics).reshape(-1, 2)
    images = []
    for view in range(cameras.num_views):
        rays = rays_through(pixels, cameras.cam_from_world[view], cameras.intrinsics[view])
        centre = cameras.centers_world[view]
        a, b = rays.square().sum(-1), rays @ centre
        root = b.square() - a * (centre.square().sum() - 1)
        depth = (-b - root.clamp_min(0).sqrt()) / a
        if wall:
            depth, root = (WALL - centre[2]) / rays[:, 2], torch.ones_like(depth)
        points = centre + depth[:, None] * rays
        light = torch.ones(4, dtype=torch.float64) * torch.tensor([1.0, 0, 0, 0])
        if lit:
            rotation = torch.tensor(2.4 * view)
            light[1:] = 0.7 * torch.stack([rotation.cos(), rotation.sin(), -0.5 * torch.ones(())])
            light *= 1 + 0.3 * view
        shading = (light[0] + points @ light[1:]).clamp_min(0)
        images.append(torch.where(root > 0, 0.1 * albedo(points) * shading, 0.01))
    return views_of(torch.stack(images).reshape(-1, 1, HEIGHT, WIDTH).clamp_max(0.99))


def points_on_the_wall(count: int, generator: torch.Generator) -> Tensor:
    """Draw points that all cameras see."""
    points = torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5
    points[:, 2] = WALL
    return points


def points_on_the_ball(count: int, generator: torch.Generator) -> Tensor:
    """Draw points on the side that all cameras see."""
    points = torch.randn(8 * count, 3, generator=generator, dtype=torch.float64)
    points = points / points.norm(dim=1, keepdim=True)
    return points[points[:, 2] < -0.75][:count]


def model_of(
    cameras: Cameras,
    points: Tensor,
    generator: torch.Generator,
    noise_px: float,
    fraction: float = 1.0,
) -> SparseModel:
    """Observe points with noise, in a fraction of the views."""
    seen = torch.rand(len(points), cameras.num_views, generator=generator) < fraction
    seen[:, :2] = True
    params = (FOCAL, WIDTH / 2, HEIGHT / 2, 0.0)
    lens = CameraModel(camera=1, model="SIMPLE_RADIAL", params=params, width=WIDTH, height=HEIGHT)
    return observed(cameras, points, seen, lens=lens, noise_px=noise_px, generator=generator)
