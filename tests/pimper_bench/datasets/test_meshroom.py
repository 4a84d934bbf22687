import json

import pytest
import torch

from pimper_bench.datasets import read_camera_file
from pimper_torch.runtime.errors import InputError

# `hand_camera` in the file's format: columns of R, and the camera's centre.
ROTATION = ["0", "0", "1", "1", "0", "0", "0", "1", "0"]
POSE = {"transform": {"rotation": ROTATION, "center": ["-4", "2", "3"]}, "locked": "0"}
# Focal lengths 20 and 30 px of 16 px, on a sensor 32 mm wide; principal point (6.5, 4.5)
# from the first pixel's centre.
OLD = {"pxFocalLength": "20", "principalPoint": ["6.5", "4.5"]}
NEW = {
    "sensorWidth": "32",
    "focalLength": "40",
    "pixelRatio": "1.5",
    "principalPoint": ["-1.5", "-1.5"],
}


@pytest.fixture
def save(tmp_path, paint):
    """Write cameras.sfm: two views with a pose, one without."""
    for name in ("a.png", "b.png"):
        paint(tmp_path / name, 100)

    def write(version="1.2.6", intrinsic=NEW, view=None, **more):
        whole = {
            "version": version.split("."),
            "views": [
                {"viewId": "7", "poseId": "7", "intrinsicId": "3", "path": "/x/y/a.png"},
                {"viewId": "8", "poseId": "8", "intrinsicId": "3", "path": "C:\\x\\b.png"},
                {"viewId": "9", "poseId": "9", "intrinsicId": "3", "path": "/x/y/c.png"},
            ],
            "intrinsics": [
                {"intrinsicId": "3", "width": "16", "height": "12", "type": "pinhole"} | intrinsic
            ],
            "poses": [{"poseId": "7", "pose": POSE}, {"poseId": "8", "pose": POSE}],
        }
        whole["views"][0] |= view or {}
        (tmp_path / "cameras.sfm").write_text(json.dumps(whole | more))
        return tmp_path

    return write


@pytest.mark.parametrize(
    ("version", "intrinsic", "expected"),
    [
        ("1.0.0", OLD, [9, 9]),
        ("1.2.0", OLD | {"pxFocalLength": ["20", "30"]}, [9, 11]),
        (
            "1.2.1",
            OLD | {"pxFocalLength": ["20", "30"], "principalPoint": ["-1.5", "-1.5"]},
            [9, 11],
        ),
        ("1.2.4", NEW | {"pixelRatio": str(2 / 3)}, [9, 11]),
        ("1.2.5", NEW, [9, 11]),
        ("1.2.14", NEW, [9, 11]),
    ],
)
def test_every_version_of_the_file_gives_the_same_camera(
    save, sees, hand_camera, version, intrinsic, expected
):
    capture = read_camera_file(save(version, intrinsic))
    assert capture.views.names == ("a.png", "b.png")  # the third view is not registered
    assert sees(capture) == pytest.approx(expected)
    assert torch.allclose(capture.cameras.cam_from_world[0], hand_camera)


def test_photographs_are_found_by_name(save, sees, tmp_path, paint):
    save()
    for name in ("a.png", "b.png"):
        (tmp_path / name).unlink()
        paint(tmp_path / "images" / name, 100)
    assert sees(read_camera_file(tmp_path)) == pytest.approx([9, 11])
    (tmp_path / "images").rename(tmp_path / "pictures")
    again = read_camera_file(tmp_path / "cameras.sfm", images=tmp_path / "pictures")
    assert sees(again) == pytest.approx([9, 11])


NO_PINHOLE = {"type": "radial3", "distortionParams": ["0.01", "0", "0"], "pixelRatio": "1e-320"}
BROWN = 0.1 * 0.05 - 0.3 * 0.05**2 + 2 * 0.05**3  # k1, k2, k3 at r^2 = 0.05


@pytest.mark.parametrize(
    ("kind", "params", "x", "y"),
    [
        ({"type": "radial1"}, ["0.1"], 0.1 * 1.005, 0.2 * 1.005),
        ({"type": "radial3"}, ["0.1", "-0.3", "2"], 0.1 * (1 + BROWN), 0.2 * (1 + BROWN)),
        (
            {"distortionType": "radialk3"},
            ["0.1", "-0.3", "2"],
            0.1 * (1 + BROWN),
            0.2 * (1 + BROWN),
        ),
        ({"distortionType": "none"}, "", 0.1, 0.2),
        (
            {"distortionType": "brown"},
            ["0.1", "-0.3", "2", "0.4", "-0.5"],
            0.1 * (1 + BROWN) + 2 * 0.4 * 0.02 - 0.5 * (0.05 + 2 * 0.01),
            0.2 * (1 + BROWN) + 0.4 * (0.05 + 2 * 0.04) - 2 * 0.5 * 0.02,
        ),
    ],
)
def test_distortions_are_read(save, lens_of, kind, params, x, y):
    at = lens_of(
        read_camera_file, save(intrinsic=NEW | kind | {"distortionParams": params}), 0.1, 0.2
    )
    assert at == pytest.approx([7 + 20 * x, 5 + 30 * y])


@pytest.mark.parametrize(
    ("options", "needed"),
    [
        ({"version": "1.2"}, "3 finite numbers as version"),
        ({"intrinsic": NEW | {"type": "equidistant"}}, "a distortion that is one of"),
        (
            {"intrinsic": NEW | {"type": "radial3", "distortionParams": ["1"]}},
            "a distortion that is one",
        ),
        ({"intrinsic": NEW | {"undistortionParams": ["1"]}}, "and an undistortion"),
        ({"intrinsic": NEW | {"focalLength": "-1"}}, "a positive focal length"),
        ({"intrinsic": NEW | {"focalLength": "1e308"}}, "a positive focal length"),
        ({"intrinsic": NEW | {"sensorWidth": "0"}}, "a positive focal length"),
        ({"intrinsic": NEW | NO_PINHOLE}, "gives no pinhole"),
        ({"intrinsic": {"principalPoint": ["1", "1"]}}, "focalLength of an intrinsic"),
        ({"view": {"rigId": "1", "isPoseIndependant": "false"}}, "a pose in a rig"),
        ({"view": {"path": "/x/d.png"}}, r"one photograph named d\.png"),
        ({"poses": [{"poseId": "7"}]}, "pose.transform for a.png"),
        ({"poses": [{"poseId": "1", "pose": POSE}]}, "views with a pose"),
        ({"poses": []}, "a list of objects as poses"),
    ],
)
def test_an_unknown_file_is_refused(save, options, needed):
    with pytest.raises(InputError, match=needed):
        read_camera_file(save(**options))


def test_a_folder_without_the_file_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"cameras\.sfm"):
        read_camera_file(tmp_path)
