"""Shapes as signed distance functions, and their silhouettes."""

from collections.abc import Callable
from functools import cache

import torch
from scenes import trusted
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.pinholes import look_at, pinholes
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import rays_through
from pimper_torch.records import Cameras, Silhouettes
from pimper_torch.stages.silhouettes.cuts import Cuts

WIDTH, HEIGHT, FOCAL, DISTANCE = 120, 100, 180.0, 5.0
PIXEL = DISTANCE / FOCAL  # at the origin


def all_round() -> Cameras:
    """Return twenty views of the origin from all sides."""
    index = torch.arange(20, dtype=torch.float64) + 0.5
    z, angle = 1 - index / 10, torch.pi * (1 + 5**0.5) * index
    flat = (1 - z**2).sqrt()
    eyes = DISTANCE * torch.stack([flat * angle.cos(), flat * angle.sin(), z], dim=1)
    up = torch.tensor([0.1, 0.2, 1.0]).double()
    return pinholes(look_at(eyes, torch.zeros(3).double(), up), FOCAL, WIDTH, HEIGHT)


@cache
def silhouettes_of(
    distance: Callable[[Tensor], Tensor], cameras: Cameras, reach: float = 1.5
) -> Silhouettes:
    """Draw the silhouettes of a signed distance function around the origin."""
    masks = []
    for view in range(cameras.num_views):
        pixels = pixel_centers(WIDTH, HEIGHT, like=cameras.intrinsics).reshape(-1, 2)
        rays = rays_through(pixels, cameras.cam_from_world[view], cameras.intrinsics[view])
        masks.append(nearest_to(distance, cameras.centers_world[view], rays, reach)[0] < 0)
    return trusted(torch.stack(masks).reshape(-1, HEIGHT, WIDTH).double())


def nearest_to(
    distance: Callable[[Tensor], Tensor], centers: Tensor, rays: Tensor, reach: float = 1.5
) -> tuple[Tensor, Tensor]:
    """Return the smallest distance along rays within a ball around the origin, and its point."""
    rays = normalize(rays, dim=-1)
    centre = -(centers * rays).sum(dim=-1)
    best, place = None, None
    for step in torch.linspace(-reach, reach, 121).to(rays):
        points = centers + (centre + step)[:, None] * rays
        found = distance(points)
        nearer = torch.ones_like(found, dtype=torch.bool) if best is None else found < best
        best = found if best is None else torch.where(nearer, found, best)
        place = points if place is None else torch.where(nearer[:, None], points, place)
    assert best is not None
    assert place is not None
    return best, place


def cuts_of(masks: Tensor, margins_px: Tensor) -> Cuts:
    """Return cuts that agree with all cues."""
    none = torch.zeros(len(masks), dtype=torch.float64)
    return Cuts(
        masks=masks,
        margins_px=margins_px,
        exposed=none,
        held=1 + none,
        rejected=none > 0,
        agreement=None,
    )


def ball(points: Tensor) -> Tensor:
    return points.norm(dim=-1) - 1


def ring(points: Tensor) -> Tensor:
    """Return the distance to a torus about the z axis, with radii 0.9 and 0.35."""
    flat = points[..., :2].norm(dim=-1) - 0.9
    return torch.stack([flat, points[..., 2]], dim=-1).norm(dim=-1) - 0.35


CENTERS = torch.tensor([[-0.6, 0.0, 0.0], [0.6, 0.2, 0.1]], dtype=torch.float64)


def two_balls(points: Tensor) -> Tensor:
    """Return the distance to two separate balls of radius 0.5, partly hidden in some views."""
    return (points[..., None, :] - CENTERS).norm(dim=-1).amin(dim=-1) - 0.5
