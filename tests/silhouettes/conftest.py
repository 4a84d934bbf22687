from dataclasses import dataclass

import pytest
import torch
from scenes import observed
from torch import Tensor

from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import project, rays_through
from pimper_torch.records import CameraModel, Cameras, SparseScene, Views
from pimper_torch.stages.silhouettes import cuts
from pimper_torch.stages.silhouettes.silhouette_config import SilhouetteConfig
from tests.silhouettes.shapes import all_round

# The ball is supported by the plane z = 0.
CENTER, RADIUS = torch.tensor([0.0, 0.0, 0.5]), 0.5


SMALL = SilhouetteConfig(size_px=240)


@pytest.fixture(autouse=True)
def few_voxels(monkeypatch):
    monkeypatch.setattr(cuts, "NUM_VOXELS", 60_000)


def overlap(found: Tensor, truth: Tensor) -> Tensor:
    return (found & truth).sum(dim=(1, 2)) / (found | truth).sum(dim=(1, 2))


@dataclass(frozen=True)
class Staged:
    """A ball on a table, and its true silhouettes."""

    scene: SparseScene
    truth: Tensor


@pytest.fixture(scope="session")
def staged() -> Staged:
    """Twelve views of a red, speckled ball on a grey, speckled table, each exposed differently."""
    generator = torch.Generator().manual_seed(5)
    cameras = arc_cameras(
        12, width=240, height=180, focal_px=300.0, distance=3.0, span_deg=60.0,
        elevation_deg=35.0, target=(0.0, 0.0, 0.4), front=(0.0, -1.0, 0.0), up=(0.0, 0.0, 1.0),
    )  # fmt: skip
    cameras = cameras.to(torch.float32)
    pixels = pixel_centers(240, 180, like=cameras.intrinsics).reshape(-1, 2)
    rays = rays_through(pixels, cameras.cam_from_world, cameras.intrinsics)
    eyes = cameras.centers_world[:, None].expand_as(rays)
    on_ball, meets = _ball(eyes, rays)
    on_table = eyes - rays * (eyes[..., 2:] / rays[..., 2:])
    waves = 40 * torch.randn(24, 3, generator=generator)
    red, grey = torch.tensor([0.7, 0.2, 0.1]), torch.tensor([0.4, 0.4, 0.4])
    colour = torch.where(
        meets[..., None], red * _speckle(on_ball, waves), grey * _speckle(on_table, waves / 2)
    )
    exposure = 0.5 + 0.5 * torch.rand(12, 1, 1, generator=generator)
    images = (exposure * colour).mT.reshape(12, 3, 180, 240)
    images = (images + 0.003 * torch.randn(images.shape, generator=generator)).clamp(0, 1)
    views = Views(
        images=images,
        sizes_px=cameras.sizes_px,
        names=tuple(f"{view:02d}.png" for view in range(12)),
        focals_px=torch.full((12,), 300.0),
    )
    truth = meets.reshape(12, 180, 240)
    return Staged(scene=_cloud(views, cameras, generator), truth=truth)


def _ball(eyes: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    away = eyes - CENTER
    a, b, c = (rays**2).sum(-1), (rays * away).sum(-1), (away**2).sum(-1) - RADIUS**2
    inner = b**2 - a * c
    along = (-b - inner.clamp_min(0).sqrt()) / a
    return eyes + along[..., None] * rays, inner > 0


def _speckle(points: Tensor, waves: Tensor) -> Tensor:
    return (1 + 0.5 * torch.tanh((points @ waves.T).sin().sum(dim=-1, keepdim=True) / 3)) / 1.5


def _cloud(views: Views, cameras, generator: torch.Generator) -> SparseScene:
    """Return points on the upper side of the ball and on the table, with their observations."""
    flat = 3 * torch.rand(600, 2, generator=generator) - 1.5
    flat = flat[flat.norm(dim=1) > 0.6]
    table = torch.cat([flat, torch.zeros(len(flat), 1)], dim=1)
    outward = torch.nn.functional.normalize(torch.randn(400, 3, generator=generator), dim=1)
    ball = CENTER + RADIUS * outward[outward[:, 2] > -0.5]
    points = torch.cat([table, ball])
    pixels, _ = project(points, cameras.cam_from_world, cameras.intrinsics)
    rays = points - cameras.centers_world[:, None]
    _, hidden = _ball(cameras.centers_world[:, None].expand_as(rays), rays)
    normal = torch.cat([torch.tensor([[0.0, 0, 1]]).expand(len(table), 3), (ball - CENTER)])
    faces = (normal * rays).sum(-1) < -0.2 * rays.norm(dim=-1) * normal.norm(dim=-1)
    hidden[:, len(table) :] = False
    framed = (pixels > 2).all(-1) & (pixels < torch.tensor([238.0, 178.0])).all(-1)
    lens = CameraModel(
        camera=1, model="PINHOLE", params=(300.0, 300.0, 120.0, 90.0), width=240, height=180
    )
    return observed(views, cameras, points, pixels, faces & ~hidden & framed, lens)


@pytest.fixture(scope="session")
def cameras() -> Cameras:
    return all_round()
