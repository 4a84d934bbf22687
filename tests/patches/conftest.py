import pytest
import torch

from pimper_bench.scenes.render_in_memory import EndlessPlane, RenderedScene, render_shape
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.records import CoarseMesh, Mesh

TILTED = EndlessPlane(point=(0.0, 0.0, 0.0), normal=(0.2, -0.1, 1.0))


def ramp(points: torch.Tensor) -> torch.Tensor:
    """Return albedo as an affine function of position, so that interpolation is exact."""
    x, y = points[..., 0], points[..., 1]
    return torch.stack([0.5 + 0.2 * x, 0.5 + 0.2 * y, 0.5 - 0.1 * x + 0.1 * y], dim=-1)


@pytest.fixture(scope="session")
def plane_scene() -> RenderedScene:
    """A tilted plane with a ramp of albedo under constant light, 5 views."""
    cameras = arc_cameras(5, width=200, height=160, focal_px=260.0, distance=4.0)
    lights = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).expand(5, 4)
    return render_shape(TILTED, cameras, lights, ramp)


@pytest.fixture(scope="session")
def plane_mesh() -> CoarseMesh:
    """Two facets of different sizes on the tilted plane, frontal in the centre view."""
    xy = torch.tensor([[-0.8, -0.6], [0.7, -0.5], [0.5, 0.6], [-0.3, 0.5]], dtype=torch.float64)
    z = -(0.2 * xy[:, :1] - 0.1 * xy[:, 1:])
    mesh = Mesh(
        vertices_world=torch.cat([xy, z], dim=1), faces=torch.tensor([[0, 1, 2], [0, 2, 3]])
    )
    return CoarseMesh(mesh=mesh, reference=2, is_point=torch.ones(4, dtype=torch.bool))
