import numpy as np
import pytest
import torch

from pimper_bench.datasets import read_llff
from pimper_torch.runtime.errors import InputError

# World directions of a camera that looks along x with its right along y and its down along z
# (`hand_camera`), in the file's order: down, right, back, place, (height, width, focal length).
ROW = [[0, 0, -1, -4, 12], [0, 1, 0, 2, 16], [1, 0, 0, 3, 20]]


@pytest.fixture
def folder(tmp_path, paint):
    """Two photographs with different lexicographic and natural order; the second is farther."""
    rows = np.zeros((2, 17))
    rows[:, :15] = np.array(ROW, dtype=float).reshape(-1)
    rows[1, 3] = -14.0
    np.save(tmp_path / "poses_bounds.npy", rows)
    for name in ("10.png", "9.png"):
        paint(tmp_path / "images" / name, 100)
    return tmp_path


def test_pose_columns_are_down_right_and_back(folder, sees, hand_camera):
    capture = read_llff(folder)
    # 1 right, 2 down, 10 ahead; focal length 20, principal point (8, 6).
    assert sees(capture) == pytest.approx([10, 10])
    assert torch.equal(capture.cameras.cam_from_world[0], hand_camera)


def test_rows_belong_to_lexicographically_sorted_names(folder):
    capture = read_llff(folder)
    assert capture.views.names == ("10.png", "9.png")
    assert capture.cameras.centers_world[:, 0].tolist() == [-4, -14]
    assert read_llff(folder, names=["9.png"]).cameras.centers_world.tolist() == [[-14, 2, 3]]


def test_a_smaller_copy_of_the_photographs_has_smaller_cameras(folder, paint, sees):
    for name in ("10.png", "9.png"):
        paint(folder / "images_2" / name, 100, 8, 6)
        paint(folder / "images_4" / name, 100, 4, 3)
    assert sees(read_llff(folder, images="images_4")) == pytest.approx([2.5, 2.5])
    (folder / "images").rename(folder / "originals")
    assert sees(read_llff(folder)) == pytest.approx([5, 5])


def test_masks_next_to_the_photographs_are_found(folder, paint):
    assert read_llff(folder).views.masks is None
    for name in ("10-removebg-preview.png", "9-removebg-preview.png"):
        paint(folder / "images_mask" / name, 0, 8, 6)
    masks = read_llff(folder).views.masks
    assert masks.sum(dim=(1, 2)).tolist() == [48, 48]
    assert masks[:, :6, :8].all()


def _with(row, column, value):
    def spoil(rows):
        rows[row, column] = value
        return rows

    return spoil


@pytest.mark.parametrize(
    ("spoil", "needed"),
    [
        (lambda rows: rows[:, :15], r"shape \(views, 17\)"),
        (lambda rows: np.full((2, 17), np.nan), r"shape \(views, 17\)"),
        (lambda rows: rows.astype(int), r"shape \(views, 17\)"),
        (lambda rows: rows[:1], r"1 photographs, one for each row.*Found: 2"),
        (_with(0, 2, 1.0), "a reflection"),  # back becomes forward
        (_with(0, 14, 0.0), "height, width and focal length"),
    ],
)
def test_read_llff_refuses_other_arrays(folder, spoil, needed):
    np.save(folder / "poses_bounds.npy", spoil(np.load(folder / "poses_bounds.npy")))
    with pytest.raises(InputError, match=needed):
        read_llff(folder)


@pytest.mark.parametrize(
    ("missing", "needed"),
    [("poses_bounds.npy", r"a file poses_bounds\.npy"), ("images", "a folder `images`")],
)
def test_read_llff_names_missing_files(folder, missing, needed):
    (folder / missing).rename(folder / "elsewhere")
    with pytest.raises(InputError, match=needed):
        read_llff(folder)
