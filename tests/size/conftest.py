import pytest
import torch

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.method.sfm.undistort import pinhole_for
from pimper_torch.records import Lens, Mesh, Silhouettes

WIDTH, HEIGHT, FOCAL = 640, 480, 700.0


@pytest.fixture
def ball(reconstruction):
    """A ball of radius 1 at the origin before five photographs through a lens that bulges."""
    lens = Lens(
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
    scene = reconstruction.scene.replace(
        views=views, cameras=cameras, lenses=(lens,) * 5, unregistered=("IMG_9.jpg",), **no_points()
    )
    return reconstruction.replace(
        mesh=Mesh(vertices_world=vertices.float(), faces=faces),
        scene=scene,
        silhouettes=Silhouettes.everything(views),
    )


def no_points():
    none = torch.zeros(0, dtype=torch.long)
    return {
        "points_world": torch.zeros(0, 3),
        "reprojection_errors_px": torch.zeros(0),
        "observation_point": none,
        "observation_view": none,
        "observation_pixels": torch.zeros(0, 2),
    }
