import sys

import pytest
import torch
from torch.testing import assert_close

from pimper_torch.errors import ConfigError, MissingProgramError, ReconstructionError
from pimper_torch.evidence.baselines.pmvs import Pmvs, PmvsConfig, projections
from pimper_torch.geometry.projection import project
from pimper_torch.radiometry import to_bytes

POINTS = """ply
format ascii 1.0
element vertex 2
property float x
property float y
property float z
property float nx
property float ny
property float nz
property uchar diffuse_red
property uchar diffuse_green
property uchar diffuse_blue
property float quality
end_header
0.5 -0.25 1.5 0 0.6 0.8 200 100 50 0.9
0.25 0.125 1.25 0 0 1 200 100 50 0.7
"""

# Reads what PMVS2 would read, in its own words, and writes to models/ what it would write.
FAKE = """#!{python}
import pathlib, shutil, sys
prefix, option = sys.argv[1:]
assert prefix.endswith("/")
shutil.copytree(prefix, {copy!r})
pathlib.Path(prefix + "models/" + option + ".ply").write_text({points!r})
"""


@pytest.fixture(autouse=True)
def _no_pmvs(monkeypatch, tmp_path):
    (tmp_path / "bin").mkdir()
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.delenv("PIMPER_PMVS2", raising=False)


def install(tmp_path, text):
    (tmp_path / "bin" / "pmvs2").write_text(text)
    (tmp_path / "bin" / "pmvs2").chmod(0o755)


def install_fake(tmp_path, points=POINTS):
    copy = tmp_path / "seen"
    install(tmp_path, FAKE.format(python=sys.executable, copy=str(copy), points=points))
    return copy


def read_matrix(path):
    header, *rows = path.read_text().splitlines()
    assert header == "CONTOUR"
    numbers = [[float(word) for word in row.split()] for row in rows]
    return torch.tensor(numbers, dtype=torch.float64)


def test_points_come_back_in_the_scenes_frame(reconstruction, tmp_path):
    install_fake(tmp_path)
    scene, coarse = reconstruction.scene, reconstruction.coarse
    estimate = Pmvs()(scene, coarse)
    assert_close(
        estimate.mesh.vertices_world, torch.tensor([[0.5, -0.25, 1.5], [0.25, 0.125, 1.25]])
    )
    assert_close(estimate.mesh.normals_world, torch.tensor([[0, 0.6, 0.8], [0, 0, 1.0]]))
    assert estimate.mesh.faces.shape == (0, 3)
    assert estimate.mesh.albedo is None  # its colours are radiance
    assert estimate.names == scene.views.names
    assert estimate.cameras is scene.cameras
    assert estimate.reference == "b.png"


def test_a_point_projects_with_the_written_matrix_to_its_pixel_counted_from_centres(
    reconstruction, tmp_path
):
    copy = install_fake(tmp_path)
    scene = reconstruction.scene
    skewed = scene.cameras.intrinsics.clone()
    skewed[:, 0, 1], skewed[:, 1, 1], skewed[:, 0, 2] = 0.7, 80.0, 27.0
    scene = scene.replace(cameras=scene.cameras.replace(intrinsics=skewed))
    Pmvs(PmvsConfig(level=0))(scene, reconstruction.coarse)
    points = scene.points_world.double()
    homogeneous = torch.cat([points, torch.ones(len(points), 1)], dim=1)
    for view in range(3):
        seen = homogeneous @ read_matrix(copy / "txt" / f"{view:08d}.txt").T
        pixels, depth = project(
            points, scene.cameras.cam_from_world[view].double(), skewed[view].double()
        )
        assert_close(seen[:, :2] / seen[:, 2:], pixels - 0.5, rtol=0, atol=1e-9)
        assert_close(seen[:, 2], depth, rtol=0, atol=1e-9)  # its optical axis is of unit length


@pytest.mark.parametrize("level", [0, 1, 3])
def test_pixels_are_right_on_the_level_of_the_pyramid_that_is_worked_on(reconstruction, level):
    cameras = reconstruction.scene.cameras
    # A ramp of brightness u along the rows, brought down as PMVS2 does: its values on a level
    # say where on the finest level a coarse pixel really looks.
    ramp = torch.arange(256, dtype=torch.float64)
    for _ in range(level):
        ramp = (ramp[:-3] + 3 * ramp[1:-2] + 3 * ramp[2:-1] + ramp[3:])[1::2] / 8
        ramp = torch.cat([ramp[:1] - (ramp[1] - ramp[0]), ramp])  # its first pixel again
    point = torch.tensor([[0.3, -0.2, 0.4, 1.0]], dtype=torch.float64)
    matrix = projections(cameras, level)[0]
    matrix = torch.cat([matrix[:2] / 2**level, matrix[2:]])  # as PMVS2 halves them
    u = float((point @ matrix.T)[0, 0] / (point @ matrix.T)[0, 2])
    below, fraction = int(u), u - int(u)
    looks_at = (1 - fraction) * ramp[below] + fraction * ramp[below + 1]
    pixels, _ = project(
        point[:, :3], cameras.cam_from_world[0].double(), cameras.intrinsics[0].double()
    )
    assert_close(looks_at, pixels[0, 0] - 0.5, rtol=0, atol=1e-6)


def test_photographs_and_masks_are_handed_over_without_loss_and_padding(reconstruction, tmp_path):
    from PIL import Image

    copy = install_fake(tmp_path)
    scene = reconstruction.scene
    sizes = torch.tensor([[60, 40], [50, 30], [60, 40]])
    masks = torch.zeros(3, 40, 60, dtype=torch.bool)
    masks[1, 5:9, 10:20] = True
    scene = scene.replace(
        views=scene.views.replace(images=scene.views.images[:, :1], sizes_px=sizes, masks=masks),
        cameras=scene.cameras.replace(sizes_px=sizes),
    )
    Pmvs()(scene, reconstruction.coarse)
    with Image.open(copy / "visualize" / "00000001.ppm") as picture:
        assert picture.mode == "RGB"
        assert picture.size == (50, 30)
        wanted = int(to_bytes(scene.views.images[1, 0, 29, 49]))
        assert picture.getpixel((49, 29)) == (wanted,) * 3
    with Image.open(copy / "masks" / "00000001.pgm") as mask:
        assert mask.size == (50, 30)
        assert mask.getpixel((10, 5)) == 255
        assert mask.getpixel((20, 5)) == 0


def test_the_options_name_every_view_and_setting(reconstruction, tmp_path):
    copy = install_fake(tmp_path)
    config = PmvsConfig(level=2, csize=3, threshold=0.6, wsize=9, min_images=2, threads=5)
    Pmvs(config)(reconstruction.scene, reconstruction.coarse)
    lines = dict(line.split(" ", 1) for line in (copy / "option").read_text().splitlines())
    wanted = {
        "timages": "-1 0 3",
        "oimages": "0",
        "level": "2",
        "csize": "3",
        "threshold": "0.6",
        "wsize": "9",
        "minImageNum": "2",
        "CPU": "5",
    }
    assert wanted.items() <= lines.items()
    assert not (copy / "masks").exists()  # nobody drew any


def test_a_missing_pmvs_is_named(reconstruction):
    with pytest.raises(MissingProgramError, match="pmvs2 is not installed"):
        Pmvs()(reconstruction.scene, reconstruction.coarse)


def test_a_pmvs_that_finds_nothing_is_said_so(reconstruction, tmp_path):
    install(tmp_path, f"#!{sys.executable}\nprint('no seeds')")
    with pytest.raises(ReconstructionError, match=r"(?s)left no option.ply.*no seeds"):
        Pmvs()(reconstruction.scene, reconstruction.coarse)
    empty = POINTS.replace("vertex 2", "vertex 0").split("end_header\n")[0] + "end_header\n"
    (tmp_path / "bin" / "pmvs2").unlink()
    install_fake(tmp_path, empty)
    with pytest.raises(ReconstructionError, match="found no surface"):
        Pmvs()(reconstruction.scene, reconstruction.coarse)


def test_impossible_settings_are_refused():
    for setting in ({"level": -1}, {"csize": 0}, {"min_images": 1}, {"max_minutes": 0.0}):
        with pytest.raises(ConfigError, match=next(iter(setting))):
            PmvsConfig(**setting)
