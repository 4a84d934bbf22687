import numpy as np
import pytest
import scipy.io
import torch
from torch.testing import assert_close

from pimper_bench.datasets.dtu_sets import read_dtu_points
from pimper_torch.geometry.projection import project
from pimper_torch.io import radiance
from pimper_torch.runtime.errors import InputError


@pytest.fixture
def folder(tmp_path, save_calibration, paint):
    for place in (1, 2, 3):
        for point_light in (1, 2, 19):
            paint(
                tmp_path / "SET004" / f"Img{place:03d}_{point_light:02d}.bmp",
                40 * place + point_light,
            )
    save_calibration(tmp_path / "Calib_Results_11.mat")
    (tmp_path / "CleanRecon_2009_11_16").mkdir()
    scipy.io.savemat(
        tmp_path / "CleanRecon_2009_11_16" / "Clean_Reconstruction_04.mat",
        {
            "pts3D_near": np.arange(20.0).reshape(5, 4),
            "pts3D_far": np.full((5, 2), 7.0),
        },
    )
    return tmp_path


def test_all_photographs_have_position_point_light_camera_and_scan(folder, rig):
    capture = read_dtu_points(folder, 4)
    assert capture.position.tolist() == [1, 1, 1, 2, 2, 2, 3, 3, 3]
    assert capture.light.tolist() == [1, 2, 19] * 3
    assert capture.views.names[4] == "Img002_02.bmp"
    # Linear: 82 of 255, not decoded from sRGB.
    assert_close(capture.views.images[4, :, -1, -1], torch.full((3,), 82 / 255))
    # Points are columns of both halves; only the first three rows are coordinates.
    points = capture.truth.points_world
    assert points.shape == (6, 3)
    assert_close(points[1], torch.tensor([1.0, 5.0, 9.0]))
    assert_close(points[5], torch.full((3,), 7.0))
    # The photographs have a hundredth of the calibration's width.
    at = torch.tensor([[0.02, -0.03, 0.01]], dtype=torch.float64)
    full, _ = project(at, rig.cam_from_world[1], rig.intrinsics[1])
    small, depth = project(at.float(), *_camera(capture, 4))
    assert_close(small, (full / 100).float(), atol=1e-4, rtol=0)
    assert (depth > 0).all()


def _camera(capture, view):
    return capture.cameras.cam_from_world[view], capture.cameras.intrinsics[view]


def test_only_selected_photographs_are_decoded(folder, monkeypatch):
    decoded = []
    monkeypatch.setattr(
        radiance,
        "decode",
        lambda path, *size, real=radiance.decode: decoded.append(path.name) or real(path, *size),
    )
    capture = read_dtu_points(folder, 4, light_seed=5, lights=(1, 2))
    assert capture.position.tolist() == [1, 2, 3]
    assert capture.light[0] != capture.light[1] != capture.light[2]
    assert decoded == list(capture.views.names)
    assert len(decoded) == 3


def test_the_calibration_may_have_the_file_name_of_the_download(folder):
    (folder / "Calib_Results_11.mat").rename(folder / "calibrationFile.mat")
    assert read_dtu_points(folder, 4).cameras.num_views == 9


def test_a_scene_without_its_scan_has_no_points(folder):
    (folder / "CleanRecon_2009_11_16" / "Clean_Reconstruction_04.mat").unlink()
    assert read_dtu_points(folder, 4).truth.points_world is None


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda at, save: (at / "SET004").rename(at / "scan4"), r"SET004.*Found: .*scan4"),
        (lambda at, save: (at / "Calib_Results_11.mat").unlink(), r"calibrationFile\.mat"),
        (
            lambda at, save: scipy.io.savemat(at / "Calib_Results_11.mat", {"K": np.eye(3)}),
            r"variables fc, cc, Rc_1.*Found: variables K",
        ),
        (
            lambda at, save: (at / "Calib_Results_11.mat").write_bytes(b"\x89HDF\r\n"),
            r"Calib_Results_11\.mat: cannot be read as a MATLAB file",
        ),
        (
            lambda at, save: save(at / "Calib_Results_11.mat", KK=np.eye(4)),
            r"KK as finite numbers of shape 3 x 3.*4 x 4",
        ),
    ],
)
def test_a_different_layout_is_refused_with_expected_and_found_files(
    folder, save_calibration, break_it, message
):
    break_it(folder, save_calibration)
    with pytest.raises(InputError, match=message):
        read_dtu_points(folder, 4)
