import dataclasses
import inspect
import json
from typing import get_args

import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from pimper_bench.cli import convert
from pimper_bench.cli.convert import ReadOptions, Source, cloud, layouts
from pimper_bench.datasets import read_colmap, read_idr, read_transforms
from pimper_bench.truth import Truth
from pimper_torch.cli.main import main
from pimper_torch.geometry.rigid import transform
from pimper_torch.radiometry import LINEAR, Encoding
from pimper_torch.records import Mesh

READERS = {"colmap": read_colmap, "idr": read_idr, "transforms": read_transforms}
# From OpenGL camera axes to the world: at (1, 2, 3 + number), looking along -z.
POSE = [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]


@pytest.fixture
def data(tmp_path):
    """A transforms.json set of three photographs with 8-bit levels."""
    folder = tmp_path / "data"
    (folder / "images").mkdir(parents=True)
    frames = []
    for number in range(3):
        noise = np.random.default_rng(number).integers(0, 256, (9, 12, 3), dtype=np.uint8)
        Image.fromarray(noise).save(folder / "images" / f"{number}.png")
        rotation = np.array(POSE, dtype=float)
        angle = 0.3 * number
        rotation[0, [0, 2]], rotation[2, [0, 2]] = (
            (np.cos(angle), np.sin(angle)),
            (-np.sin(angle), np.cos(angle)),
        )
        frames.append({"file_path": f"images/{number}.png", "transform_matrix": rotation.tolist()})
    lens = {"fl_x": 20, "fl_y": 21, "cx": 6.5, "cy": 4.25}
    (folder / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    return folder


@pytest.fixture
def converted(data, tmp_path):
    """Convert to ``out``, and return the exit code."""

    def convert(source, target, *options, folder=data):
        arguments = [str(folder), "-o", str(tmp_path / "out"), "--source", source]
        return main(["convert", *arguments, "--target", target, *map(str, options)])

    return convert


@pytest.mark.parametrize("target", READERS)
def test_a_set_survives_conversion_to_every_layout_and_back(
    data, converted, tmp_path, capsys, target
):
    assert converted("transforms", target) == 0
    before, after = read_transforms(data), READERS[target](tmp_path / "out")
    assert_close(after.views.images, before.views.images)
    assert_close(after.cameras.intrinsics, before.cameras.intrinsics)
    assert_close(after.cameras.cam_from_world, before.cameras.cam_from_world)
    printed = capsys.readouterr().out
    assert "3 photographs of 12 x 9 from 3 positions" in printed
    assert f"in the layout {target}" in printed


def test_options_reach_the_reader_and_the_writer(converted, tmp_path):
    (tmp_path / "true.obj").write_text("v 1 2 0\nv 2 2 0\nv 1 3 0\nf 1 2 3\n")
    options = ("--max-size-px", 6, "--mesh", tmp_path / "true.obj")
    assert converted("transforms", "idr", *options) == 0
    assert read_idr(tmp_path / "out").views.sizes_px.tolist() == [[6, 4]] * 3
    scale_mat = np.load(tmp_path / "out" / "cameras.npz")["scale_mat_0"]
    unit_from_world = torch.linalg.inv(torch.from_numpy(scale_mat))
    corner = transform(unit_from_world, torch.tensor([[2.0, 2, 0]]).double())
    assert_close(float(corner.norm()), 0.9)


@pytest.mark.parametrize(
    ("source", "options", "message"),
    [
        ("transforms", ["--light-seed", 0], "--light-seed: not supported for --source transforms"),
        ("rendered", ["--photographs.black", 2], "--photographs.black: not supported for --source"),
        ("dtu-mvs", [], "--scan with a number"),
        ("llff", [], r"not the layout of an LLFF set"),
    ],
)
def test_an_unreadable_set_is_refused_without_writing(
    converted, tmp_path, capsys, source, options, message
):
    assert converted(source, "idr", *options) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_set_without_cameras_is_not_exported(data, converted, tmp_path, monkeypatch, capsys):
    bare = read_transforms(data).replace(cameras=None)
    monkeypatch.setattr(convert.datasets, "read_llff", lambda folder: bare)
    assert converted("llff", "idr") == 2
    assert "has no cameras" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_encoding_of_the_files_reaches_the_reader(data, converted, tmp_path):
    told = {"response": "linear", "saturation": 250.0, "black": 2.0}
    options = [word for name in told for word in (f"--photographs.{name}", told[name])]
    assert converted("transforms", "idr", *options) == 0
    found = read_idr(tmp_path / "out").views.images
    expected = read_transforms(data, encoding=Encoding(**told)).views.images
    assert_close(found, expected, rtol=0, atol=0.01)  # 8 bits in sRGB


def test_unset_options_keep_the_values_of_the_layout(data, monkeypatch):
    asked = {}

    def stand_in(folder, *, scan, encoding=LINEAR):
        asked["encoding"] = encoding
        return read_transforms(data)

    monkeypatch.setattr(convert.datasets, "read_dtu_mvs", stand_in)
    arguments = ["data", "-o", "out", "--source", "dtu-mvs", "--target", "idr", "--scan", "3"]
    convert.read(convert.parse([*arguments, "--photographs.response", "2.2"]))
    assert asked["encoding"] == Encoding(response=2.2, saturation=LINEAR.saturation)


def test_a_large_cloud_is_thinned_evenly_over_its_length():
    points = torch.arange(3 * 250_001).reshape(-1, 3).float()
    thin = cloud(Truth(points_world=points))
    assert len(thin) == 100_000
    assert torch.equal(thin[[0, -1]], points[[0, -1]])
    mesh = Mesh(vertices_world=points[:5], faces=torch.zeros(0, 3, dtype=torch.long))
    assert torch.equal(cloud(Truth(points_world=points, mesh=mesh)), points[:5])
    assert cloud(Truth()) is None


def test_every_offered_layout_has_a_reader_with_its_options():
    assert set(layouts()) == set(get_args(Source))
    for layout in layouts().values():
        known = dict(inspect.signature(layout.read).parameters)
        if "options" in known:
            (shared,) = get_args(known["options"].annotation)
            known |= shared.__annotations__
        offered = {field.name for field in dataclasses.fields(ReadOptions)}
        assert offered & set(known) == set(layout.options)
        assert ("encoding" in known) == (layout.encoding is not None)


def test_one_light_per_position_is_selected_from_a_multi_light_set(converted, tmp_path, capsys):
    photographs = tmp_path / "Rectified" / "scan9"
    calibration = tmp_path / "Calibration" / "cal18"
    photographs.mkdir(parents=True)
    calibration.mkdir(parents=True)
    for place in (1, 2, 3):
        for point_light in (0, 3):
            level = Image.new("RGB", (16, 12), (60 * place, 20, 90 + point_light))
            level.save(photographs / f"rect_{place:03d}_{point_light}_r5000.png")
        matrix = np.array([[2000.0, 0, 800, place], [0, 2000, 600, 2], [0, 0, 1, 700]])
        np.savetxt(calibration / f"pos_{place:03d}.txt", matrix)
    options = ("--scan", 9, "--light-seed", 0)
    assert converted("dtu-mvs", "colmap", *options, folder=tmp_path) == 0
    assert "3 photographs of 16 x 12 from 3 positions, under 2 lights" in capsys.readouterr().out
    assert read_colmap(tmp_path / "out").views.num_views == 3


def test_a_rendered_scene_is_read_without_maps(data, monkeypatch):
    asked = {}
    monkeypatch.setattr(
        convert.datasets, "read_rendered", lambda folder, **options: asked.update(options)
    )
    layouts()["rendered"].read(data)
    assert asked == {"maps": False}
