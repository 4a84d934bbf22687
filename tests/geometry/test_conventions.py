"""Every convention of the package, against independent code or a hand-computed case."""

import pycolmap
import torch
from torch.nn.functional import grid_sample
from torch.testing import assert_close

from pimper_torch.geometry.pixels import (
    crop_intrinsics,
    grid_from_pixels,
    indices_from_pixels,
    pixel_centers,
    pixels_from_indices,
    scale_intrinsics,
)
from pimper_torch.geometry.projection import project

WIDTH, HEIGHT = 7, 5


def noise_image(seed):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(1, 1, HEIGHT, WIDTH, generator=generator, dtype=torch.float64)


def ramp_image(width, height):
    # The value of every pixel is the position of its centre: linear, so resampling is exact.
    return pixel_centers(width, height, like=torch.zeros(1).double()).movedim(-1, 0)[None]


def test_the_first_pixel_center_is_half_a_pixel_from_both_borders():
    centers = pixel_centers(WIDTH, HEIGHT, like=torch.zeros(1).double())
    assert centers.shape == (HEIGHT, WIDTH, 2)
    assert centers[0, 0].tolist() == [0.5, 0.5]
    assert centers[0, 1].tolist() == [1.5, 0.5]  # u goes right
    assert centers[1, 0].tolist() == [0.5, 1.5]  # v goes down
    assert centers[-1, -1].tolist() == [WIDTH - 0.5, HEIGHT - 0.5]


def test_grid_sample_at_pixel_centers_reproduces_the_image():
    image = noise_image(101)
    grid = grid_from_pixels(pixel_centers(WIDTH, HEIGHT, like=image), WIDTH, HEIGHT)
    found = grid_sample(image, grid[None], mode="bilinear", align_corners=False)
    assert_close(found, image)


def test_the_corners_of_the_image_are_the_ends_of_the_grid():
    corners = torch.tensor([[0.0, 0.0], [WIDTH, HEIGHT]], dtype=torch.float64)
    grid = grid_from_pixels(corners, WIDTH, HEIGHT)
    assert_close(grid, torch.tensor([[-1.0, -1.0], [1.0, 1.0]], dtype=torch.float64))


def test_an_index_is_the_center_of_its_pixel():
    image = noise_image(103)
    index = torch.tensor([4.0, 1.0], dtype=torch.float64)
    pixel = pixels_from_indices(index)
    assert_close(pixel, pixel_centers(WIDTH, HEIGHT, like=image)[1, 4])
    assert_close(indices_from_pixels(pixel), index)


def test_resized_images_keep_corners_and_so_intrinsics_only_scale():
    generator = torch.Generator().manual_seed(105)
    K = torch.tensor([[90.0, 0, 11.0], [0, 80, 9.5], [0, 0, 1]], dtype=torch.float64)
    points = torch.rand(20, 3, generator=generator, dtype=torch.float64) + 1
    identity = torch.eye(4, dtype=torch.float64)
    large, _ = project(points, identity, K)
    small, _ = project(points, identity, scale_intrinsics(K, 0.5, 0.25))
    assert_close(small, large * large.new_tensor([0.5, 0.25]))
    # Area averaging maps the mean of two centres, 0.5 and 1.5, to 1 = 2 * 0.5.
    halved = torch.nn.functional.avg_pool2d(ramp_image(8, 6), 2)
    assert_close(halved, 2 * ramp_image(4, 3))


def test_cropping_shifts_pixels_by_the_crop_corner():
    K = torch.tensor([[100.0, 0, 32], [0, 110, 24], [0, 0, 1]], dtype=torch.float64)
    points = torch.tensor([[0.1, 0.2, 2.0], [-0.3, 0.1, 3.0]], dtype=torch.float64)
    identity = torch.eye(4, dtype=torch.float64)
    whole, _ = project(points, identity, K)
    cut, _ = project(points, identity, crop_intrinsics(K, 5.0, 7.0))
    assert_close(cut, whole - whole.new_tensor([5, 7]))


def test_the_pinhole_agrees_with_colmap():
    camera = pycolmap.Camera(
        model="PINHOLE", width=640, height=480, params=[500.0, 510.0, 321.5, 238.25]
    )
    world_to_cam = pycolmap.Rigid3d(pycolmap.Rotation3d([0.1, -0.2, 0.3, 0.927]), [0.1, 0.2, 4.0])
    generator = torch.Generator().manual_seed(106)
    points = torch.randn(15, 3, generator=generator, dtype=torch.float64)
    cam_from_world = torch.eye(4, dtype=torch.float64)
    cam_from_world[:3] = torch.from_numpy(world_to_cam.matrix())
    K = torch.from_numpy(camera.calibration_matrix())
    pixels, depth = project(points, cam_from_world, K)
    for point, pixel, z in zip(points.numpy(), pixels, depth, strict=True):
        in_cam = world_to_cam * point
        assert_close(pixel, torch.from_numpy(camera.img_from_cam(in_cam)))
        assert_close(z, torch.tensor(in_cam[2]))
