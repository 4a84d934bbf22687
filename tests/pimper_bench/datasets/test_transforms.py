import json
import math

import numpy as np
import pytest
from photographs import photographed
from PIL import Image
from torch.testing import assert_close

from pimper_bench.datasets import read_transforms
from pimper_torch.export.nerfstudio import write_transforms
from pimper_torch.runtime.errors import InputError

# `hand_camera`: columns are the camera's right, up (its down is the world's z), back, centre.
MATRIX = [[0, 0, -1, -4], [1, 0, 0, 2], [0, -1, 0, 3], [0, 0, 0, 1]]
LENS = {"fl_x": 20, "fl_y": 30, "cx": 7, "cy": 5, "w": 16, "h": 12}


@pytest.fixture
def save(tmp_path, paint):
    """Write transforms.json with one frame per file; keywords set values of the frames."""
    for name in ("a.png", "b.png"):
        paint(tmp_path / "images" / name, 100)

    def write(whole=LENS, files=("images/a.png", "images/b.png"), path="transforms.json", **more):
        frames = [{"file_path": file, "transform_matrix": MATRIX} | more for file in files]
        (tmp_path / path).write_text(json.dumps({**whole, "frames": frames}))
        return tmp_path

    return write


def test_the_matrix_maps_opengl_camera_axes_to_the_world(save, sees, hand_camera):
    capture = read_transforms(save())
    assert sees(capture) == pytest.approx([9, 11])
    assert_close(capture.cameras.cam_from_world[1], hand_camera)
    assert capture.views.names == ("a.png", "b.png")


def test_a_frame_may_have_its_own_intrinsics(save, sees):
    assert sees(read_transforms(save(cx=6, fl_y=25))) == pytest.approx([8, 10])
    assert sees(read_transforms(save({}, **LENS))) == pytest.approx([9, 11])


def test_blender_files_have_an_angle_and_no_suffix(save, sees, paint, tmp_path):
    # 16 pixels wide, so the focal length is 8 / tan(angle / 2) = 20; the centre is (8, 6).
    angle = 2 * math.atan(8 / 20)
    files = ("./images/a", "./train/a")
    paint(tmp_path / "train" / "a.png", 100)
    folder = save({"camera_angle_x": angle}, files, "transforms_train.json")
    capture = read_transforms(folder)
    assert sees(capture) == pytest.approx([10, 10])
    assert capture.views.names == ("images/a.png", "train/a.png")
    assert sees(read_transforms(folder / "transforms_train.json")) == pytest.approx([10, 10])


def test_a_vertical_angle_gives_the_other_focal_length(save, sees):
    angles = {"camera_angle_x": 2 * math.atan(8 / 20), "camera_angle_y": 2 * math.atan(6 / 30)}
    assert sees(read_transforms(save(angles))) == pytest.approx([10, 12])


def test_alpha_is_the_mask_unless_there_is_a_mask_file(save, tmp_path):
    array = np.full((12, 16, 4), 200, dtype=np.uint8)
    array[:4, :, 3] = 0
    Image.fromarray(array).save(tmp_path / "images" / "a.png")
    masks = read_transforms(save()).views.masks
    assert masks[0].sum() == 8 * 16
    Image.fromarray(array[::-1, :, 3].copy()).save(tmp_path / "m.png")
    masks = read_transforms(save(mask_path="m.png")).views.masks
    assert masks[0, :8].all()
    assert not masks[0, 8:].any()


@pytest.mark.parametrize(
    ("more", "model"),
    [
        ({"k1": 0.2}, 1 + 0.2 * 0.05),
        ({"k1": 0.1, "k2": -3.0, "k3": 9.0}, 1 + 0.1 * 0.05 - 3 * 0.05**2 + 9 * 0.05**3),
        ({"k1": 0.0, "camera_model": "SIMPLE_PINHOLE"}, 1.0),
    ],
)
def test_the_distortion_model_is_that_of_opencv(save, lens_of, more, model):
    # The point is at x = 0.1, y = 0.2, so r^2 = 0.05; the lens moves it along the radius.
    found = lens_of(read_transforms, save(**more), 0.1, 0.2)
    assert found == pytest.approx([7 + 20 * 0.1 * model, 5 + 30 * 0.2 * model])


def test_tangential_terms_are_in_opencvs_order(save, lens_of):
    found = lens_of(read_transforms, save(p1=0.3, p2=-0.1), 0.1, 0.2)
    x = 0.1 + 2 * 0.3 * 0.02 - 0.1 * (0.05 + 2 * 0.01)
    y = 0.2 + 0.3 * (0.05 + 2 * 0.04) - 2 * 0.1 * 0.02
    assert found == pytest.approx([7 + 20 * x, 5 + 30 * y])


def test_a_fisheye_distorts_by_the_angle(save, lens_of):
    more = {"camera_model": "OPENCV_FISHEYE", "k1": 0.5, "k4": 2.0}
    found = lens_of(read_transforms, save(**more), 0.1, 0.2)
    radius = math.sqrt(0.05)
    angle = math.atan(radius)
    bent = angle * (1 + 0.5 * angle**2 + 2 * angle**8) / radius
    assert found == pytest.approx([7 + 2 * bent, 5 + 6 * bent])


def test_the_rational_terms_of_opencv_are_a_denominator(save, lens_of):
    more = {"k1": 0.2, "k2": -1.0, "k3": 3.0, "k4": 0.5, "k5": 2.0, "k6": -8.0, "p1": 0.3}
    found = lens_of(read_transforms, save(camera_model="FULL_OPENCV", **more), 0.1, 0.2)
    r2 = 0.05
    ratio = (1 + 0.2 * r2 - r2**2 + 3 * r2**3) / (1 + 0.5 * r2 + 2 * r2**2 - 8 * r2**3)
    x, y = 0.1 * ratio + 2 * 0.3 * 0.02, 0.2 * ratio + 0.3 * (r2 + 2 * 0.04)
    assert found == pytest.approx([7 + 20 * x, 5 + 30 * y])


@pytest.mark.parametrize(
    ("more", "needed"),
    [
        ({"transform_matrix": None}, "4 rows of 4 numbers"),
        ({"transform_matrix": [[1, 2], [3, 4], [5, 6]]}, "12 finite numbers"),
        ({"transform_matrix": (2 * np.array(MATRIX)).tolist()}, "a rotation in"),
        ({"file_path": "../a.png"}, "leads out of it"),
        ({"file_path": 7}, "a text as file_path"),
        ({"mask_path": "/etc/passwd"}, "leads out of it"),
        ({"mask_path": "none.png"}, "the mask of a photograph"),
        ({"camera_model": "EQUIRECTANGULAR"}, "a camera_model of"),
        ({"k4": 0.1}, "k4 = 0"),
        ({"k6": 0.1}, r"k4 = 0 for .*Found: k3 to k6 = \[0\.0, 0\.0, 0\.0, 0\.1\]"),
        ({"k5": 0.1, "camera_model": "OPENCV_FISHEYE"}, "k5 = 0"),
        ({"k1": "much"}, "1 finite number as k1"),
        ({"fl_x": 0, "fl_y": 0}, "fl_x or camera_angle_x"),
        (
            {"fl_x": 0, "fl_y": 0, "camera_angle_x": 90},
            r"camera_angle_x of .* is 90; needed: radians, below pi\. .* write 1\.5708\.",
        ),
    ],
)
def test_an_invalid_frame_is_refused(save, more, needed):
    with pytest.raises(InputError, match=needed):
        read_transforms(save(files=("images/a.png",), **more))


def test_intrinsics_shared_by_all_views_are_written_once(tmp_path):
    views, cameras, _ = photographed(4)
    write_transforms(views.take([0]), cameras.take([0]), tmp_path / "one")
    said = json.loads((tmp_path / "one" / "transforms.json").read_text())
    assert said["fl_x"] == pytest.approx(float(cameras.intrinsics[0, 0, 0]))
    assert "fl_x" not in said["frames"][0]
    write_transforms(views, cameras, tmp_path / "two")
    said = json.loads((tmp_path / "two" / "transforms.json").read_text())
    assert "fl_x" not in said
    assert [frame["w"] for frame in said["frames"]] == views.sizes_px[:, 0].tolist()
