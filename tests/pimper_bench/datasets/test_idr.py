import numpy as np
import pytest
import torch
from photographs import photographed
from torch.testing import assert_close

from pimper_bench.datasets import read_idr
from pimper_bench.datasets.idr import unit_sphere
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.geometry.rigid import transform
from pimper_torch.runtime.errors import InputError

# K [R t] of `hand_camera`, K = [[20, 5, 6.5], [0, 30, 4.5], [0, 0, 1]], worked out by hand:
# the rows of R pick y, z, x; t = (-2, -3, 4).
WORLD = [[6.5, 20, 5, -29], [4.5, 0, 30, -72], [1, 0, 0, 4], [0, 0, 0, 1.0]]
SCALE = [[2, 0, 0, 6], [0, 2, 0, 3], [0, 0, 2, 5], [0, 0, 0, 1.0]]


@pytest.fixture
def folder(tmp_path, paint):
    for name in ("000.png", "001.png"):
        paint(tmp_path / "image" / name, 100)
        paint(tmp_path / "mask" / name, 0)
    save(tmp_path)
    return tmp_path


def save(folder, name="cameras.npz", count=2, **more):
    arrays = {f"world_mat_{index}": np.array(WORLD) for index in range(count)}
    arrays |= {f"world_mat_inv_{index}": np.linalg.inv(WORLD) for index in range(count)}
    arrays |= {f"scale_mat_{index}": np.array(SCALE) for index in range(count)}
    np.savez(folder / name, **(arrays | more))


def test_the_matrix_maps_the_world_to_pixels_counted_from_0(folder, sees, hand_camera):
    capture = read_idr(folder)
    assert sees(capture) == pytest.approx([10, 11])
    assert_close(capture.cameras.cam_from_world[0], hand_camera)
    assert_close(float(capture.cameras.intrinsics[0, 0, 1]), 5.0)
    assert capture.views.masks.sum(dim=(1, 2)).tolist() == [48, 48]


def test_a_matrix_known_up_to_a_negative_factor_gives_the_same_camera(folder, sees):
    save(folder, world_mat_1=-3 * np.array(WORLD))
    assert sees(read_idr(folder), 1) == pytest.approx([10, 11])


def test_other_camera_files_are_found(folder, sees):
    (folder / "cameras.npz").rename(folder / "cameras_sphere.npz")
    assert sees(read_idr(folder)) == pytest.approx([10, 11])
    (folder / "cameras_sphere.npz").rename(folder / "mine.npz")
    assert sees(read_idr(folder, camera_file="mine.npz")) == pytest.approx([10, 11])
    with pytest.raises(InputError, match=r"a file cameras\.npz or .*mine\.npz"):
        read_idr(folder)


@pytest.mark.parametrize(
    ("matrix", "needed"),
    [
        (np.diag([1.0, 1, 0, 1]), r"K \[R t\] as each .* number 1"),
        (np.full((4, 4), np.nan), "16 finite numbers"),
        (np.ones((3, 3)), "16 finite numbers"),
    ],
)
def test_an_invalid_projection_matrix_is_refused(folder, matrix, needed):
    save(folder, world_mat_1=matrix)
    with pytest.raises(InputError, match=needed):
        read_idr(folder)


def test_the_unit_sphere_contains_the_points():
    _, cameras, points = photographed(4)
    unit_from_world = torch.linalg.inv(unit_sphere(cameras, points))
    radius = transform(unit_from_world, points.double()).norm(dim=-1).max()
    assert_close(float(radius), 0.9)
    # One factor for all axes, no rotation.
    assert_close(unit_from_world[:3, :3], unit_from_world[0, 0] * torch.eye(3).double())


def test_without_points_the_sphere_is_where_the_cameras_look():
    cameras = arc_cameras(5, width=160, height=120, focal_px=200.0, distance=4.0)
    world_from_unit = unit_sphere(cameras)
    assert_close(world_from_unit[:3, 3], torch.zeros(3).double(), rtol=0, atol=1e-9)
    assert_close(float(world_from_unit[0, 0]), 4 * 100 / 200)  # up to the corner at (80, 60)


def test_masks_determine_the_size_of_the_sphere():
    cameras = arc_cameras(3, width=160, height=120, focal_px=200.0, distance=4.0)
    row, column = torch.meshgrid(torch.arange(120) + 0.5, torch.arange(160) + 0.5, indexing="ij")
    radius_px = torch.tensor([10.0, 20.0, 15.0])[:, None, None]
    masks = (column - 80).square() + (row - 60).square() < radius_px.square()
    reach = float(unit_sphere(cameras, masks=masks)[0, 0])
    assert abs(reach * 0.9 * 200 / 4 - 20) < 0.71  # the farthest pixel's centre


@pytest.mark.parametrize(
    ("spoil", "needed"),
    [
        (lambda at: save(at, count=3), r"2 photographs.*Found: 3 cameras"),
        (lambda at: (at / "mask" / "000.png").unlink(), "2 masks"),
    ],
)
def test_read_idr_refuses_other_numbers_of_cameras_and_masks(folder, spoil, needed):
    spoil(folder)
    with pytest.raises(InputError, match=needed):
        read_idr(folder)


def test_unit_sphere_refuses_a_scene_without_extent():
    _, cameras, _ = photographed(4)
    with pytest.raises(InputError, match="look the same way"):
        unit_sphere(cameras.take([0, 0]))
    with pytest.raises(InputError, match="has no size"):
        unit_sphere(cameras, torch.ones(4, 3))
