"""COLMAP's files: agreement with COLMAP, and damaged files."""

import math
import struct

import pytest
import torch
from sparse_models import observed
from torch.testing import assert_close

from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.geometry.colmap_library import loaded
from pimper_torch.io.cameras.model_files import read_model
from pimper_torch.runtime.errors import InputError, PimperWarning
from pimper_torch.stages.sfm.colmap import model_of, reconstruction_of, write_binary

POINTS, VIEWS = 20, 4
COLORS = torch.zeros(POINTS, 3, dtype=torch.uint8)


def four_views():
    """Return four views of twenty points, each seen by three views."""
    generator = torch.Generator().manual_seed(4)
    cameras = arc_cameras(VIEWS, width=64, height=48, focal_px=80.0, distance=5.0)
    points = torch.randn(POINTS, 3, generator=generator, dtype=torch.float64)
    seen = (torch.arange(POINTS)[:, None] + 3) % VIEWS != torch.arange(VIEWS)
    model = observed(cameras.to(torch.float64), points, seen)
    return model.replace(names=("a b.png", "c/d.png", "e.png", "f.png"))


@pytest.fixture
def model():
    return four_views()


@pytest.fixture
def folder(model, tmp_path):
    write_binary(model, COLORS, tmp_path)
    return tmp_path


def change(path, layout, at, *values):
    data = bytearray(path.read_bytes())
    struct.pack_into(layout, data, at, *values)
    path.write_bytes(data)


@pytest.mark.parametrize("text", [False, True])
def test_files_are_read_as_by_colmap(model, tmp_path, text):
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


def test_a_name_with_spaces_and_line_ends_of_unicode_is_read_from_text(model, tmp_path):
    names = ("a  b.png", "c\u2028d.png", "e\u00a0f.png", "g\x85h\x1ci.png")
    reconstruction_of(model.replace(names=names), COLORS).write_text(str(tmp_path))
    read = read_model(tmp_path)
    assert read.names == names
    assert len(read.observation_point) == len(model.observation_point)


def test_windows_line_ends_are_read(model, tmp_path):
    reconstruction_of(model, COLORS).write_text(str(tmp_path))
    for path in tmp_path.glob("*.txt"):
        path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    assert read_model(tmp_path).names == model.names


NAN = math.nan
SHORT = b"\xff" * 4096, struct.pack("<Q", 2**40), b"", b"\1"


@pytest.mark.parametrize(
    "damage",
    [
        *(
            lambda folder, part=part, content=content: (folder / part).write_bytes(content)
            for part in ("cameras.bin", "images.bin", "points3D.bin")
            for content in SHORT
        ),
        lambda folder: change(folder / "points3D.bin", "<Q", 8 + 43, 2**64 - 1),  # of a track
        lambda folder: change(folder / "points3D.bin", "<Q", 8 + 43, 10**9),
        lambda folder: as_text(folder, "cameras", "1 PINHOLE 64 48 80"),
        lambda folder: as_text(folder, "images", "1 1 0 0 0"),
        lambda folder: as_text(folder, "points3D", "x"),
    ],
)
def test_truncated_or_foreign_files_are_rejected(folder, damage):
    damage(folder)
    with pytest.raises(InputError, match="cannot be read: truncated or malformed"):
        read_model(folder)


def as_text(folder, part, line):
    """Replace binary files by text, with a line prepended to one of them."""
    for path in folder.iterdir():
        path.unlink()
    reconstruction_of(four_views(), COLORS).write_text(str(folder))
    path = folder / f"{part}.txt"
    path.write_text(f"{line}\n{path.read_text()}")


def test_a_duplicate_image_is_rejected(model, tmp_path):
    twice = model.replace(names=("a.png", "b.png", "a.png", "c.png"))
    reconstruction_of(twice, COLORS).write_text(str(tmp_path))
    with pytest.raises(InputError, match=r"is broken: a\.png appears twice"):
        read_model(tmp_path)


@pytest.mark.parametrize(
    ("name", "layout", "at", "values"),
    [
        ("images", "<4d", 4, [0.0] * 4),
        ("images", "<4d", 4, [NAN] * 4),
        ("images", "<d", 4 + 32, [NAN]),
        ("images", "<I", 60, [99]),  # a missing camera
        ("cameras", "<d", 24, [NAN]),
        ("cameras", "<d", 24, [0.0]),
        ("cameras", "<d", 32, [-1.0]),
        ("cameras", "<Q", 8, [0]),  # an image without width
    ],
)
def test_an_image_without_a_valid_pose_or_camera_is_rejected(folder, name, layout, at, values):
    change(folder / f"{name}.bin", layout, 8 + at, *values)
    with pytest.raises(InputError, match=r"is broken: a b\.png has no valid pose or camera"):
        read_model(folder)


def test_dangling_points_and_observations_are_dropped_and_counted(folder, model):
    size = 43 + 8 + 3 * 8
    for index in range(0, POINTS, 2):
        change(folder / "points3D.bin", "<d", 8 + size * index + 8, NAN)
    change(folder / "points3D.bin", "<2I", 8 + size + 51, 99, 0)
    change(folder / "points3D.bin", "<I", 8 + size + 51 + 8 + 4, 2**32 - 1)
    with pytest.warns(PimperWarning, match=f"{POINTS // 2} of {POINTS} points.*2 observations"):
        read = read_model(folder)
    assert_close(read.points_world, model.points_world[1::2])
    assert int(read.observation_point.max()) == POINTS // 2 - 1
    assert torch.bincount(read.observation_point).tolist() == [1] + [3] * (POINTS // 2 - 1)
