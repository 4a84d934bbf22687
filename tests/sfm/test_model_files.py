"""COLMAP's files: as COLMAP reads them, and what is broken in them."""

import math
import struct
import warnings

import pytest
import torch
from torch.testing import assert_close

from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.ground.geometry.colmap_library import loaded
from pimper_torch.ground.geometry.lens_models import pinhole_lenses
from pimper_torch.ground.geometry.projection import project
from pimper_torch.method.sfm.colmap import model_of, read_model, reconstruction_of, write_binary
from pimper_torch.method.sfm.model import SparseModel
from pimper_torch.method.sfm.model_files import CAMERA_MODELS
from pimper_torch.runtime.errors import InputError, PimperWarning

POINTS, VIEWS = 20, 4
COLORS = torch.zeros(POINTS, 3, dtype=torch.uint8)


@pytest.fixture
def model():
    """Four views of twenty points, each of which three views see."""
    generator = torch.Generator().manual_seed(4)
    cameras = arc_cameras(VIEWS, width=64, height=48, focal_px=80.0, distance=5.0)
    points = torch.randn(POINTS, 3, generator=generator, dtype=torch.float64)
    pixels, _ = project(points, cameras.cam_from_world, cameras.intrinsics)
    point = torch.arange(POINTS).repeat_interleave(3)
    view = (point + torch.arange(3).repeat(POINTS)) % VIEWS
    order = torch.argsort(point * VIEWS + view)
    return SparseModel(
        names=("a b.png", "c/d.png", "e.png", "f.png"),
        lenses=pinhole_lenses(cameras),
        cam_from_world=cameras.cam_from_world.double(),
        points_world=points,
        observation_point=point[order],
        observation_view=view[order],
        observation_pixels=pixels[view[order], point[order]].double(),
    )


@pytest.fixture
def folder(model, tmp_path):
    write_binary(model, COLORS, tmp_path)
    return tmp_path


def change(path, layout, at, *values):
    data = bytearray(path.read_bytes())
    struct.pack_into(layout, data, at, *values)
    path.write_bytes(data)


def image_at(folder, index):
    """Find where an image begins in its file."""
    data, at = (folder / "images.bin").read_bytes(), 8
    for _ in range(index):
        end = data.index(b"\0", at + 64) + 1
        at = end + 8 + 24 * struct.unpack_from("<Q", data, end)[0]
    return at


def quietly(folder):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PimperWarning)
        return read_model(folder)


@pytest.mark.parametrize("text", [False, True])
def test_files_are_read_as_colmap_reads_them(model, tmp_path, text):
    if text:
        model = model.replace(names=("a.png", *model.names[1:]))
    own = reconstruction_of(model, COLORS)
    (own.write_text if text else own.write_binary)(str(tmp_path))
    read, oracle = read_model(tmp_path), model_of(loaded().Reconstruction(str(tmp_path)))
    assert read.names == oracle.names == model.names
    assert read.lenses == oracle.lenses
    assert_close(read.cam_from_world, oracle.cam_from_world, rtol=0, atol=1e-14)  # rounding
    assert torch.equal(read.points_world, oracle.points_world)
    tracks = [
        sorted(zip(one.observation_point.tolist(), one.observation_view.tolist(),
                   one.observation_pixels.tolist(), strict=True))
        for one in (read, oracle)
    ]  # fmt: skip
    assert tracks[0] == tracks[1]


def test_a_name_with_whatever_unicode_takes_for_spaces_and_line_ends_is_read_from_text(
    model, tmp_path
):
    names = ("a  b.png", "c\u2028d.png", "e\u00a0f.png", "g\x85h\x1ci.png")
    reconstruction_of(model.replace(names=names), COLORS).write_text(str(tmp_path))
    read = read_model(tmp_path)
    assert read.names == names
    assert len(read.observation_point) == len(model.observation_point)


def test_lines_that_end_as_windows_ends_them_are_read(model, tmp_path):
    reconstruction_of(model, COLORS).write_text(str(tmp_path))
    for path in tmp_path.glob("*.txt"):
        path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    assert read_model(tmp_path).names == model.names


def test_camera_models_are_colmaps():
    pycolmap = loaded()
    known = {
        int(kind): name
        for name, kind in pycolmap.CameraModelId.__members__.items()
        if int(kind) >= 0
    }
    assert [known[index] for index in range(len(known))] == [name for name, _ in CAMERA_MODELS]
    for name, count in CAMERA_MODELS:
        camera = pycolmap.Camera.create_from_model_name(1, name, 1.0, 8, 8)
        assert len(camera.params) == count


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_count_beyond_the_files_length_is_refused_before_memory_is_taken(folder, name):
    for content in (b"\xff" * 4096, struct.pack("<Q", 2**40), b"", b"\1"):
        (folder / name).write_bytes(content)
        with pytest.raises(InputError, match=f"{name} is cut short"):
            read_model(folder)


@pytest.mark.parametrize("count", [2**64 - 1, 10**9])
def test_a_track_longer_than_the_file_is_refused(folder, count):
    change(folder / "points3D.bin", "<Q", 8 + 43, count)
    with pytest.raises(InputError, match=r"points3D\.bin is cut short"):
        read_model(folder)


@pytest.mark.parametrize("value", [0.0, math.nan, math.inf])
def test_an_image_without_a_rotation_is_refused_by_name(folder, value):
    change(folder / "images.bin", "<4d", image_at(folder, 1) + 4, *[value] * 4)
    with pytest.raises(InputError, match=r"c/d\.png has a pose whose quaternion"):
        read_model(folder)


def test_points_that_are_nowhere_are_left_out_and_counted(folder, model):
    record = 8 + 43 + 8 + 3 * 8
    size = record - 8
    for index in range(0, POINTS, 2):
        change(folder / "points3D.bin", "<d", 8 + size * index + 8, math.nan)
    with pytest.warns(PimperWarning, match=f"{POINTS // 2} of {POINTS} points"):
        read = read_model(folder)
    assert_close(read.points_world, model.points_world[1::2])
    assert int(read.observation_point.max()) == POINTS // 2 - 1
    change(folder / "points3D.bin", "<d", 8 + size + 8, math.inf)
    with pytest.raises(InputError, match=f"broken.*{POINTS // 2 + 1} of {POINTS} points"):
        read_model(folder)


def test_cameras_that_are_none_are_the_reason_that_is_given(folder):
    for at, value, why in ((24, math.nan, "not finite"), (24, 0.0, "focal"), (24, -1.0, "focal")):
        change(folder / "cameras.bin", "<d", 8 + at, value)
        with pytest.raises(InputError, match=f"a b.png has a camera .*{why}"):
            read_model(folder)


def test_poses_that_are_none_are_the_reason_that_is_given(folder):
    change(folder / "images.bin", "<d", image_at(folder, 2) + 4 + 32, math.nan)
    with pytest.raises(InputError, match=r"e\.png has a pose that is not finite"):
        read_model(folder)


def test_observations_of_nothing_are_left_out_and_counted(folder, model):
    first = 8 + 43 + 8
    change(folder / "points3D.bin", "<2I", first, 99, 0)
    change(folder / "points3D.bin", "<I", first + 8 + 4, 2**32 - 1)
    with pytest.warns(PimperWarning, match="and 2 observations"):
        read = read_model(folder)
    assert len(read.observation_point) == 3 * POINTS - 2
    assert int((read.observation_point == 0).sum()) == 1


def test_text_that_is_none_of_colmaps_names_its_line(model, tmp_path):
    reconstruction_of(model, COLORS).write_text(str(tmp_path))
    for name, line in (
        ("cameras", "1 PINHOLE 64 48 80"),
        ("images", "1 1 0 0 0"),
        ("points3D", "x"),
    ):
        path = tmp_path / f"{name}.txt"
        sound = path.read_text()
        path.write_text(f"{line}\n{sound}")
        with pytest.raises(InputError, match=rf"{name}.txt has in line 1 "):
            read_model(tmp_path)
        path.write_text(sound)
    assert quietly(tmp_path).num_views == VIEWS
