import numpy as np
import pytest
import scipy.io
import torch
from PIL import Image

from pimper_torch.records import Mesh, StageReport
from pimper_torch.scenes.cameras import arc_cameras
from pimper_torch.scenes.meshes import icosphere


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    noise = np.random.default_rng(76).integers(0, 256, (24, 32, 3), dtype=np.uint8)
    for number in range(3):
        Image.fromarray(noise).save(folder / f"{number}.png")
    return folder


@pytest.fixture
def chain(reconstruction, monkeypatch):
    """Put a chain in the place of the real one that tells what it was given."""
    from pimper_torch.cli import run
    from pimper_torch.io import results

    class Chain:
        given = None

        def __init__(self, config, observer, cache):
            self.config, self.observer, self.cache = config, observer, cache

        def __call__(self, views, sparse_model=None, mesh=None):
            Chain.given = (self.config, views, sparse_model)
            Chain.mesh = mesh
            self.observer.started("warp")
            self.observer.progressed(1, 2)
            self.work()
            self.observer.finished(
                StageReport(name="warp", seconds=1.0, peak_memory_mb=9.0, figures={"samples": 1200})
            )
            return reconstruction

        def work(self):
            """Whatever a test wants to happen in the middle of a run."""

    draw = results.draw_overview
    monkeypatch.setattr(results, "draw_overview", lambda result, path: draw(result, path, 40))
    monkeypatch.setattr(run, "make_chain", Chain)
    return Chain


@pytest.fixture(scope="session")
def dtu(tmp_path_factory):
    """Write scan 9 of three places, seen under lights 0 and 3, with the files of its protocol."""
    cameras = arc_cameras(3, width=1600, height=1200, focal_px=2000.0, distance=600.0)
    root = tmp_path_factory.mktemp("dtu")
    photographs, calibration = root / "Rectified" / "scan9", root / "Calibration" / "cal18"
    for folder in (photographs, calibration, root / "Points" / "stl", root / "ObsMask"):
        folder.mkdir(parents=True)
    K = cameras.intrinsics.clone()
    K[:, :2, 2] -= 0.5
    picture = Image.fromarray(np.full((1200, 1600, 3), 90, dtype=np.uint8))
    for place in (1, 2, 3):
        for light in (0, 3):
            picture.save(photographs / f"rect_{place:03d}_{light}_r5000.png")
        matrix = K[place - 1] @ cameras.cam_from_world[place - 1, :3]
        np.savetxt(calibration / f"pos_{place:03d}.txt", matrix.numpy())
    vertices, _ = icosphere(4)
    cloud = Mesh(vertices_world=10 * vertices, faces=torch.zeros(0, 3, dtype=torch.long))
    write_cloud(cloud, root / "Points" / "stl" / "stl009_total.ply")
    corners = np.array([[-12.0] * 3, [12.0] * 3])
    mask = {"ObsMask": np.ones((25, 25, 25)), "BB": corners, "Res": np.array([[1.0]])}
    scipy.io.savemat(root / "ObsMask" / "ObsMask9_10.mat", mask)
    scipy.io.savemat(root / "ObsMask" / "Plane9.mat", {"P": np.array([[0.0], [0], [1], [20]])})
    return root


def write_cloud(cloud, path):
    rows = "\n".join(" ".join(f"{x:.6f}" for x in row) for row in cloud.vertices_world.tolist())
    head = "\n".join(f"property float {axis}" for axis in "xyz")
    count = len(cloud.vertices_world)
    path.write_text(f"ply\nformat ascii 1.0\nelement vertex {count}\n{head}\nend_header\n{rows}\n")
