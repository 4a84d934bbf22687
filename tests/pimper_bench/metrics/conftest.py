from dataclasses import dataclass

import pytest
import torch

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_bench.truth import Capture, Truth
from pimper_torch.geometry.rigid import rigid, transform
from pimper_torch.records import Cameras, Mesh, Views


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(83)


@pytest.fixture
def make():
    return Makers()


@dataclass(frozen=True)
class Makers:
    """Surfaces and captures with figures that can be computed by hand."""

    def square(self, height=0.0, side=1.0):
        corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]).double()
        corners = side * corners + torch.tensor([0.0, 0.0, height]).double()
        return Mesh(vertices_world=corners, faces=torch.tensor([[0, 1, 2], [0, 2, 3]]))

    def sphere(self, radius=1.0, level=5):
        vertices, faces = icosphere(level)
        return Mesh(vertices_world=radius * vertices, faces=faces)

    def half_sphere(self, level=5):
        """Return the faces of a sphere with a centroid above z = 0."""
        mesh = self.sphere(level=level)
        above = mesh.vertices_world[mesh.faces].mean(dim=1)[:, 2] > 0
        return mesh.replace(faces=mesh.faces[above])

    def potato(self, level=4):
        """Return an ellipsoid with bumps that has no symmetries."""
        vertices, faces = icosphere(level)
        x, y, z = vertices.unbind(dim=1)
        bumps = 1 + 0.15 * torch.sin(3 * x + 1) * torch.cos(2 * y) + 0.1 * torch.sin(4 * z + x)
        return Mesh(
            vertices_world=vertices * bumps[:, None] * vertices.new_tensor([1.3, 1.0, 0.8]),
            faces=faces,
        )

    def capture(self, truth, cameras=None, names=None, position=None):
        count = 0 if cameras is None else cameras.num_views
        order = torch.arange(count)
        return Capture(
            views=Views(
                images=torch.zeros(count, 1, 1, 1),
                sizes_px=torch.ones(count, 2, dtype=torch.long),
                names=tuple(names or (f"view_{index}.png" for index in range(count))),
                focals_px=torch.full((count,), torch.nan),
            ),
            cameras=cameras,
            truth=truth,
            position=order if position is None else position,
            light=order,
        )

    def capture_of(self, mesh, **more):
        return self.capture(Truth(mesh=mesh), **more)

    def cameras(self, count=5, span_deg=60.0):
        return arc_cameras(
            count, width=60, height=60, focal_px=90.0, distance=5.0, span_deg=span_deg
        )

    def rotation(self, generator, angle_deg=None):
        axis = torch.nn.functional.normalize(
            torch.randn(3, generator=generator, dtype=torch.float64), dim=0
        )
        angle = 70.0 if angle_deg is None else angle_deg
        x, y, z = (torch.deg2rad(torch.tensor(angle, dtype=torch.float64)) * axis).tolist()
        skew = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
        return torch.linalg.matrix_exp(skew)

    def moved(self, mesh, target_from_source):
        return mesh.replace(vertices_world=transform(target_from_source, mesh.vertices_world))

    def transferred(self, cameras: Cameras, scale, rotation, translation) -> Cameras:
        centers = transform(rigid(scale * rotation, translation), cameras.centers_world)
        rotated = cameras.cam_from_world[:, :3, :3] @ rotation.mT
        return cameras.replace(
            cam_from_world=rigid(rotated, -(rotated @ centers[..., None])[..., 0])
        )
