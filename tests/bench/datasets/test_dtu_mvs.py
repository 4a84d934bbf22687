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
    """Scan 9: three places, lights 0, 3 and max, and the set's own files."""
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


def save_mvsnet(folder, rig, factor=1.0):
    (folder / "Cameras").mkdir()
    for place in (1, 2, 3):
        K = rig.intrinsics[place - 1].clone()
        K[:2, 2] -= 0.5
        K[:2] *= factor
        rows = ["extrinsic"]
        rows += [" ".join(str(float(x)) for x in row) for row in rig.cam_from_world[place - 1]]
        rows += ["", "intrinsic"] + [" ".join(str(float(x)) for x in row) for row in K]
        rows += ["", "425.0 2.5"]
        (folder / "Cameras" / f"{place - 1:08d}_cam.txt").write_text("\n".join(rows) + "\n")


def check_cameras(capture, rig):
    index = capture.position - 1
    assert_close(capture.cameras.cam_from_world, rig.cam_from_world[index].float())
    scaled = rig.intrinsics[index].clone()
    scaled[:, :2] /= 100  # 16 pixels instead of 1600
    assert_close(capture.cameras.intrinsics, scaled.float(), atol=1e-5, rtol=1e-5)


def test_photographs_come_with_the_cameras_of_their_positions_and_the_scan(folder, rig):
    capture = read_dtu_mvs(folder, 9)
    assert capture.position.tolist() == [1, 1, 2, 2, 3, 3]
    assert capture.light.tolist() == [0, 3] * 3  # `max` is no light of its own
    check_cameras(capture, rig)
    assert_close(capture.truth.points_world, torch.tensor([[1.0, 2, 3], [4, 5, 600]]))


def test_mvsnets_cameras_serve_as_well(folder, rig):
    for path in (folder / "Calibration" / "cal18").iterdir():
        path.unlink()
    (folder / "Calibration" / "cal18").rmdir()
    save_mvsnet(folder, rig)
    check_cameras(read_dtu_mvs(folder, 9), rig)


def test_the_brightest_of_all_lights_is_read_when_asked_for(folder):
    capture = read_dtu_mvs(folder, 9, lights=[ALL_LIGHTS])
    assert capture.views.names == tuple(f"rect_{place:03d}_max.png" for place in (1, 2, 3))


def test_one_light_a_position(folder):
    capture = read_dtu_mvs(folder, 9, light_seed=0, positions=(1, 3))
    assert capture.position.tolist() == [1, 3]
    assert capture.light[0] != capture.light[1]


def test_the_protocol_has_the_grid_of_the_files(folder):
    protocol = read_dtu_protocol(folder, 9)
    assert protocol.obs_mask.nonzero().tolist() == [[3, 1, 0]]  # x, y, z as in MATLAB
    assert protocol.resolution == 10.0
    assert protocol.bounding_box.tolist() == [[-10, -20, 600], [20, 10, 610]]
    assert protocol.plane.tolist() == [0, 1, -2, 3]


def test_cameras_for_mvsnets_small_training_copies_are_refused(folder, rig):
    (folder / "Calibration" / "cal18").rename(folder / "Calibration" / "cal19")
    save_mvsnet(folder, rig, factor=0.1)
    with pytest.raises(InputError, match=r"1600 x 1200.*principal point at \(80, 60\)"):
        read_dtu_mvs(folder, 9)


def test_a_folder_without_cameras_is_told_both_kinds(folder):
    (folder / "Calibration" / "cal18").rename(folder / "Calibration" / "cal19")
    with pytest.raises(InputError, match=r"cal18/pos_001\.txt and so on, or Cameras/00000000_cam"):
        read_dtu_mvs(folder, 9)


@pytest.mark.parametrize("text", ["1 2 3", "0 " * 12, "a " * 12])
def test_a_camera_file_with_something_else_is_refused(folder, text):
    (folder / "Calibration" / "cal18" / "pos_002.txt").write_text(text)
    with pytest.raises(InputError, match=r"pos_002\.txt"):
        read_dtu_mvs(folder, 9)


@pytest.mark.parametrize(
    ("read", "needed"),
    [
        (read_dtu_mvs, r"Rectified/scan2.*Found: Calibration"),
        (read_dtu_protocol, r"ObsMask2_10\.mat.*Found: ObsMask9_10\.mat, Plane9\.mat"),
    ],
)
def test_readers_refuse_a_scan_that_is_not_there(folder, read, needed):
    with pytest.raises(InputError, match=needed):
        read(folder, 2)


def test_read_dtu_protocol_refuses_a_matrix(folder):
    matrices = {"ObsMask": np.eye(3), "BB": np.eye(3)[:2], "Res": 10.0}
    scipy.io.savemat(folder / "ObsMask" / "ObsMask9_10.mat", matrices)
    with pytest.raises(InputError, match=r"a grid as ObsMask.*3 x 3"):
        read_dtu_protocol(folder, 9)
