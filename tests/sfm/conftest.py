import pytest
import torch
from sparse_models import views_of

from pimper_torch.geometry.lens_models import distort
from pimper_torch.geometry.rigid import rigid
from pimper_torch.records import CameraModel, SparseScene, Views
from pimper_torch.records.sparse_model import SparseModel
from pimper_torch.stages.sfm.sparse_scene import assemble_scene


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(5207)


@pytest.fixture
def lens() -> CameraModel:
    return CameraModel(
        camera=3, model="SIMPLE_RADIAL", params=(90.0, 41.0, 29.0, 0.08), width=80, height=60
    )


@pytest.fixture
def model(generator: torch.Generator, lens: CameraModel) -> SparseModel:
    """Five cameras with two camera models; every point of a box is seen by most views."""
    other = CameraModel(
        camera=7,
        model="OPENCV",
        params=(85.0, 88.0, 40.5, 30.5, -0.05, 0.01, 1e-3, -2e-3),
        width=80,
        height=60,
    )
    lenses = (lens, other, lens, other, lens)
    points = torch.rand(40, 3, generator=generator, dtype=torch.float64) - 0.5
    rotations = 0.2 * torch.randn(5, 3, 3, generator=generator, dtype=torch.float64)
    rotation = torch.linalg.matrix_exp(rotations - rotations.mT)
    shift = 0.1 * torch.randn(5, 3, generator=generator, dtype=torch.float64)
    poses = rigid(rotation, shift + torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64))
    seen = torch.rand(40, 5, generator=generator) < 0.7
    seen[:, :2] = True
    point, view = torch.nonzero(seen, as_tuple=True)
    points_cam = torch.einsum("vij,pj->vpi", poses[:, :3, :3], points) + poses[:, None, :3, 3]
    pixels = torch.stack([distort(lenses[v], points_cam[v]) for v in range(5)])
    noise = 0.3 * torch.randn(len(point), 2, generator=generator, dtype=torch.float64)
    return SparseModel(
        names=("b.jpg", "a.jpg", "c 1.png", "d.jpg", "ü.tif"),
        lenses=lenses,
        cam_from_world=poses,
        points_world=points,
        observation_point=point,
        observation_view=view,
        observation_pixels=pixels[view, point] + noise,
    )


@pytest.fixture
def views(generator: torch.Generator, model: SparseModel) -> Views:
    images = torch.rand(5, 3, 60, 80, generator=generator, dtype=torch.float64)
    return views_of(images, names=model.names)


@pytest.fixture
def scene(views: Views, model: SparseModel) -> SparseScene:
    return assemble_scene(views, model)
