"""A ball under lights that change from view to view."""

import torch
from scenes import trusted
from torch.nn.functional import normalize

from pimper_bench.scenes.render_in_memory import Sphere, render_shape
from pimper_bench.scenes.true_clouds import sparse_scene
from pimper_torch.geometry.pinholes import look_at, pinholes
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import rays_through
from pimper_torch.stages.coarse.coarse_config import CoarseSurfaceConfig

SETTINGS = CoarseSurfaceConfig(num_facets=600, levels=1)


def mottled(points):
    """Return waves in many directions, fine enough for matching and not repetitive."""
    generator = torch.Generator().manual_seed(3)
    waves = 14 * torch.randn(24, 3, generator=generator, dtype=torch.float64).to(points)
    phases = torch.arange(24).to(points)
    tone = torch.sin(points @ waves.T + phases).mean(dim=-1, keepdim=True)
    return (0.5 + 1.2 * tone).clamp(0.05, 1).expand_as(points)


def photographed(cameras, texture=mottled):
    generator = torch.Generator().manual_seed(0)
    count = cameras.num_views
    # The point light moves with the camera and always differs slightly.
    towards = normalize(cameras.centers_world, dim=-1)
    aside = 0.4 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    lights = torch.cat(
        [
            0.2 + 0.2 * torch.rand(count, 1, generator=generator, dtype=torch.float64),
            0.5 * normalize(towards + aside, dim=-1),
        ],
        dim=-1,
    )
    scene = render_shape(Sphere(), cameras, lights, texture)
    return sparse_scene(scene, 400, generator)


def all_round():
    """Return twelve cameras on all sides of the ball."""
    place = torch.arange(12, dtype=torch.float64)
    height = 1 - (2 * place + 1) / 12
    azimuth = place * torch.pi * (3 - 5**0.5)
    ring = (1 - height.square()).sqrt()
    eyes = 4 * torch.stack([ring * azimuth.cos(), ring * azimuth.sin(), height], dim=-1)
    frames = look_at(eyes, torch.zeros(3).double(), torch.tensor([0.1, 0.2, 1.0]).double())
    return pinholes(frames, 180.0, 120, 100)


def silhouettes_of(cameras):
    """Return silhouettes of the ball from its rays."""
    width, height = cameras.sizes_px[0].tolist()
    pixels = pixel_centers(width, height, like=cameras.intrinsics).reshape(-1, 2)
    rays = rays_through(pixels, cameras.cam_from_world, cameras.intrinsics)
    met = Sphere().intersect(cameras.centers_world[:, None], rays).isfinite()
    return trusted(met.float().reshape(-1, height, width))
