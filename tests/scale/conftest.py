import pytest
import torch
from scenes import without_points

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.geometry.undistortion import pinhole_for
from pimper_torch.records import CameraModel, Mesh, Silhouettes

WIDTH, HEIGHT, FOCAL = 640, 480, 700.0


@pytest.fixture
def ball(reconstruction):
    """A ball of radius 1 at the origin in five photographs with barrel distortion."""
    lens = CameraModel(
        camera=1,
        model="OPENCV",
        params=(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, -0.12, 0.02, 1e-3, -5e-4),
        width=WIDTH,
        height=HEIGHT,
    )
    cameras = arc_cameras(
        5, width=WIDTH, height=HEIGHT, focal_px=FOCAL, distance=4.5, span_deg=60, elevation_deg=25
    )
    cameras = cameras.replace(intrinsics=pinhole_for(lens).repeat(5, 1, 1)).to(torch.float32)
    vertices, faces = icosphere(5)
    views = reconstruction.scene.views.replace(
        images=torch.zeros(5, 3, HEIGHT, WIDTH),
        sizes_px=cameras.sizes_px,
        names=tuple(f"IMG_{number}.jpg" for number in range(5)),
        focals_px=torch.full((5,), torch.nan),
    )
    scene = without_points(reconstruction.scene).replace(
        views=views, cameras=cameras, lenses=(lens,) * 5, unregistered=("IMG_9.jpg",)
    )
    return reconstruction.replace(
        mesh=Mesh(vertices_world=vertices.float(), faces=faces),
        scene=scene,
        silhouettes=Silhouettes.everything(views),
    )
