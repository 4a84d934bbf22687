"""Cameras of Polycam and Record3D, against projections of points by hand."""

import json

import camera_writers as rigs
import pytest
import torch
from torch.testing import assert_close

from pimper_torch.io.cameras.existing import existing_model
from pimper_torch.runtime.errors import InputError

# An ARKit camera at (4, 5, 6) that looks along the world's x, with its right along the world's z
# and its up along the world's y; so its back is along -x. Columns: right, up, back, centre.
POSE = [[0, 0, -1, 4], [0, 1, 0, 5], [1, 0, 0, 6]]
QUATERNION = [0.0, -(0.5**0.5), 0.0, 0.5**0.5]  # a turn about y by -90 degrees
LENS = {"fx": 90.0, "fy": 80.0, "cx": 30.0, "cy": 25.0, "width": rigs.WIDTH, "height": rigs.HEIGHT}
# 10 ahead, 2 right and 1 up: 90 * 0.2 right of the principal point, and 80 * 0.1 above it.
POINT, PIXEL = (14.0, 6.0, 8.0), (30 + 18, 25 - 8)


def pixel_of(model, view, point):
    lens = model.lenses[view]
    x, y, z = (model.cam_from_world[view] @ torch.tensor([*point, 1.0]).double())[:3].tolist()
    fx, fy, cx, cy = lens.params
    assert lens.model == "PINHOLE"
    assert z > 0
    return fx * x / z + cx, fy * y / z + cy


def numbered(names):
    return rigs.views_of().replace(names=tuple(names))


@pytest.fixture
def polycam(tmp_path):
    """Return a function that writes ``count`` cameras, each one further along the world's y."""

    def write(count=3, **more):
        folder = tmp_path / "keyframes" / "cameras"
        folder.mkdir(parents=True, exist_ok=True)
        for index in range(count):
            rows = [[*row[:3], row[3] + index * (number == 1)] for number, row in enumerate(POSE)]
            cells = {f"t_{i}{j}": float(rows[i][j]) for i in range(3) for j in range(4)}
            text = json.dumps(
                {**LENS, **cells, "blur_score": 9.0, "timestamp": 100 + index, **more}
            )
            (folder / f"{100 + index}.json").write_text(text)
        return folder

    return write


def test_polycams_cameras_project_points_as_in_its_axes(polycam):
    views = numbered(["102.jpg", "100.jpg", "101.jpg"])
    found = existing_model(views, polycam(5))  # more cameras than photographs
    assert found.names == views.names
    for view, moved in enumerate((2, 0, 1)):
        x, y, z = POINT
        assert pixel_of(found, view, (x, y + moved, z)) == pytest.approx(PIXEL)
    # A file of the folder stands for the folder.
    again = existing_model(views, polycam(5) / "103.json")
    assert torch.equal(again.cam_from_world, found.cam_from_world)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"cx": None}, r"100\.json: .*Needed: 6 finite numbers as fx, fy, cx, cy, width, height"),
        ({"t_12": "far"}, "12 finite numbers as t_00 to t_23"),
        ({"t_00": 3.0}, r"cameras: .*a rotation in transform_matrix of 100\.jpg"),
        ({"fy": 0}, r"focal lengths and a size above 0 of 100\.jpg"),
    ],
)
def test_a_camera_of_polycam_that_lacks_a_number_is_refused(polycam, more, message):
    with pytest.raises(InputError, match=message):
        existing_model(numbered(["100.jpg", "101.jpg", "102.jpg"]), polycam(**more))


def test_other_photographs_are_refused_with_polycams_folder(polycam):
    with pytest.raises(
        InputError, match=r"The camera file .*100\.json has none of the photographs"
    ):
        existing_model(rigs.views_of(), polycam())


@pytest.fixture
def record3d(tmp_path):
    """Return a function that writes the metadata of four frames along the world's y."""

    def write(name="metadata", **more):
        K = [90.0, 0, 0, 0, 80.0, 0, 30.0, 25.0, 1]  # column by column
        poses = [[*QUATERNION, 4.0, 5.0 + index, 6.0] for index in range(4)]
        sides = {"w": rigs.WIDTH, "h": rigs.HEIGHT}
        content = {"K": K, **sides, "dw": 192, "fps": 60, "poses": poses, **more}
        (tmp_path / name).write_text(json.dumps(content))
        return tmp_path / name

    return write


@pytest.mark.parametrize("name", ["metadata", "metadata.json"])
def test_record3ds_cameras_project_points_as_in_its_axes(record3d, name):
    views = numbered(["3.jpg", "0.jpg", "2.jpg"])
    found = existing_model(views, record3d(name))
    assert found.names == views.names
    for view, moved in enumerate((3, 0, 2)):
        x, y, z = POINT
        assert pixel_of(found, view, (x, y + moved, z)) == pytest.approx(PIXEL)
    turn = torch.tensor([row[:3] for row in POSE]).double() * torch.tensor([1.0, -1, -1])
    assert_close(found.cam_from_world[1, :3, :3], turn.T, rtol=0, atol=1e-12)


def test_every_frame_of_record3d_may_have_its_own_lens(record3d):
    frames = [[90.0 + index, 80.0, 30.0, 25.0 - index] for index in range(4)]
    views = numbered(["1.jpg", "2.jpg", "3.jpg"])
    found = existing_model(views, record3d(perFrameIntrinsicCoeffs=frames))
    assert [lens.params for lens in found.lenses] == [tuple(frame) for frame in frames[1:]]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"K": [90, 80, 30, 25]}, "9 finite numbers as K"),
        ({"poses": []}, "7 finite numbers as poses"),
        ({"poses": [[0.0] * 7] * 4}, r"unit quaternions in poses\. Found: lengths of 0 to 0"),
        ({"perFrameIntrinsicCoeffs": [[90, 80, 30, 25]] * 3}, "16 finite numbers as perFrame"),
        ({"w": None}, "2 finite numbers as w and h"),
    ],
)
def test_metadata_of_record3d_that_contradict_each_other_are_refused(record3d, more, message):
    with pytest.raises(InputError, match=message):
        existing_model(numbered(["0.jpg", "1.jpg", "2.jpg"]), record3d(**more))
