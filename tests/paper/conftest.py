import pytest
import torch
from slopes import normals_from_slopes

from pimper_torch.method.patches.decompose import Decompose
from pimper_torch.method.patches.patches_config import DecomposeConfig
from pimper_torch.records import (
    Cameras,
    CoarseMesh,
    Mesh,
    PhotometricPatches,
)
from tests.coarse.conftest import dome_cloud

__all__ = ["dome_cloud"]


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(6311)


@pytest.fixture
def two_facets():
    """A square of two facets of unlike tilt, seen by one camera from above (-z)."""

    def build(samples_per_pixel, dtype=torch.float64):
        vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0.1], [1.1, 1, 0], [0, 0.9, 0.1]], dtype=dtype)
        faces = torch.tensor([[0, 2, 1], [0, 3, 2]])
        cameras = Cameras(
            intrinsics=torch.tensor([[[200.0, 0, 50], [0, 200, 50], [0, 0, 1]]], dtype=dtype),
            cam_from_world=torch.eye(4, dtype=dtype)[None].clone(),
            sizes_px=torch.tensor([[100, 100]]),
        )
        cameras.cam_from_world[0, 2, 3] = 10.0  # a unit spans 20 pixels
        mesh = Mesh(vertices_world=vertices, faces=faces)
        coarse = CoarseMesh(mesh=mesh, reference=0, is_point=torch.ones(4, dtype=torch.bool))
        config = DecomposeConfig(samples_per_pixel=samples_per_pixel, overlap_samples=3.0)
        return Decompose(config)(coarse, cameras)

    return build


@pytest.fixture
def photographed():
    """Give patches the exact normals of a height field with the slopes ``(x, y) -> (p, q)``."""

    def build(patches, slopes, keep=lambda x, y: torch.ones_like(x, dtype=torch.bool)):
        normals = []
        for templates in patches.buckets:
            x, y, _ = templates.points_patch.unbind(dim=-1)
            exact = normals_from_slopes(torch.stack(slopes(x, y), dim=-1))
            normals.append(torch.where(keep(x, y)[..., None], exact, torch.nan))
        return PhotometricPatches.of(patches, normals=normals, lights=torch.ones(1, 4))

    return build
