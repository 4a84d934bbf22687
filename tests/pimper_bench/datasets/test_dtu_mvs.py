import numpy as np
import pytest
import scipy.io
import torch
from torch.testing import assert_close

from pimper_bench.datasets.dtu_sets import ALL_LIGHTS, read_dtu_mvs, read_dtu_protocol
from pimper_torch.runtime.errors import InputError

POINTS = """ply
format ascii 1.0
element vertex 2
property float x
property float y
property float z
end_header
1 2 3
4 5 600
"""


@pytest.fixture
def folder(tmp_path, rig, paint):
    """Scan 9: three positions, lights 0, 3 and max, and the files of the set."""
    photographs = tmp_path / "Rectified" / "scan9"
    for place in (1, 2, 3):
        for point_light in ("0_r5000", "3_r5000", "max"):
            paint(photographs / f"rect_{place:03d}_{point_light}.png", 30 * place)
    (tmp_path / "Calibration" / "cal18").mkdir(parents=True)
    K = rig.intrinsics.clone()
    K[:, :2, 2] -= 0.5  # the set counts from the centre of the first pixel
    projections = 1.7 * K @ rig.cam_from_world[:, :3]
    for place in (1, 2, 3):
        path = tmp_path / "Calibration" / "cal18" / f"pos_{place:03d}.txt"
        np.savetxt(path, projections[place - 1].numpy(), fmt="%.9f")
    (tmp_path / "Points" / "stl").mkdir(parents=True)
    (tmp_path / "Points" / "stl" / "stl009_total.ply").write_text(POINTS)
    (tmp_path / "ObsMask").mkdir()
    grid = np.zeros((4, 3, 2), dtype=np.uint8)
    grid[3, 1, 0] = 1
    corners = np.array([[-10.0, -20, 600], [20, 10, 610]])
    scipy.io.savemat(
        tmp_path / "ObsMask" / "ObsMask9_10.mat",
        {"ObsMask": grid, "BB": corners, "Res": np.array([[10.0]]), "Margin": 10},
    )
    scipy.io.savemat(tmp_path / "ObsMask" / "Plane9.mat", {"P": np.array([[0.0], [1], [-2], [3]])})
    return tmp_path


def check_cameras(capture, rig):
    index = capture.position - 1
    assert_close(capture.cameras.cam_from_world, rig.cam_from_world[index].float())
    scaled = rig.intrinsics[index].clone()
    scaled[:, :2] /= 100  # 16 pixels instead of 1600
    assert_close(capture.cameras.intrinsics, scaled.float(), atol=1e-5, rtol=1e-5)


def test_photographs_have_the_cameras_of_their_positions_and_the_scan(folder, rig):
    capture = read_dtu_mvs(folder, 9)
    assert capture.position.tolist() == [1, 1, 2, 2, 3, 3]
    assert capture.light.tolist() == [0, 3] * 3  # `max` is not a separate light
    check_cameras(capture, rig)
    assert_close(capture.truth.points_world, torch.tensor([[1.0, 2, 3], [4, 5, 600]]))


def test_the_brightest_light_is_read_on_request(folder):
    capture = read_dtu_mvs(folder, 9, lights=[ALL_LIGHTS])
    assert capture.views.names == tuple(f"rect_{place:03d}_max.png" for place in (1, 2, 3))


def test_the_protocol_has_the_grid_of_the_files(folder):
    protocol = read_dtu_protocol(folder, 9)
    assert protocol.obs_mask.nonzero().tolist() == [[3, 1, 0]]  # x, y, z as in MATLAB
    assert protocol.resolution == 10.0
    assert protocol.bounding_box.tolist() == [[-10, -20, 600], [20, 10, 610]]
    assert protocol.plane.tolist() == [0, 1, -2, 3]


def _matrices(folder):
    arrays = {"ObsMask": np.eye(3), "BB": np.eye(3)[:2], "Res": 10.0}
    scipy.io.savemat(folder / "ObsMask" / "ObsMask9_10.mat", arrays)


def _camera_of(text):
    return lambda folder: (folder / "Calibration" / "cal18" / "pos_002.txt").write_text(text)


@pytest.mark.parametrize(
    ("spoil", "read", "scan", "needed"),
    [
        (_camera_of("1 2 3"), read_dtu_mvs, 9, r"pos_002\.txt.*12"),
        (_camera_of("0 " * 12), read_dtu_mvs, 9, r"pos_002\.txt.*a matrix of rank 0"),
        (_camera_of("a " * 12), read_dtu_mvs, 9, r"pos_002\.txt"),
        (
            lambda folder: (folder / "Calibration" / "cal18").rename(folder / "Cameras"),
            read_dtu_mvs,
            9,
            r"cal18/pos_001\.txt and others",
        ),
        (lambda folder: None, read_dtu_mvs, 2, r"Rectified/scan2.*Found: Calibration"),
        (
            lambda folder: None,
            read_dtu_protocol,
            2,
            r"ObsMask2_10\.mat.*Found: ObsMask9_10\.mat, Plane9\.mat",
        ),
        (_matrices, read_dtu_protocol, 9, r"a grid as ObsMask.*3 x 3"),
    ],
)
def test_a_different_layout_is_refused_with_expected_and_found_files(
    folder, spoil, read, scan, needed
):
    spoil(folder)
    with pytest.raises(InputError, match=needed):
        read(folder, scan)
