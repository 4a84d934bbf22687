import pytest
import torch

from pimper_bench.metrics import (
    compare_cameras,
    compare_lights,
    similarity_between_cameras,
)
from pimper_torch.geometry.rigid import rigid
from pimper_torch.records import Mesh

IDENTITY = torch.eye(4, dtype=torch.float64)


def lights_of(generator, count=12):
    return torch.randn(count, 4, generator=generator, dtype=torch.float64)


def test_lights_rotated_together_are_right_up_to_that_rotation(make, generator):
    truth, joint = lights_of(generator), make.rotation(generator, 25.0)
    ours = truth.clone()
    ours[:, 1:] = 0.3 * truth[:, 1:] @ joint.mT
    found = compare_lights(ours, truth, torch.eye(3).double())
    assert found.mean_rotated_deg < 1e-6
    assert found.rotation_deg == pytest.approx(25.0)
    # Lights near the axis are rotated less.
    assert 5 < found.mean_deg < 25
    assert found.lights == 12


def test_the_rotation_of_the_frames_is_undone_first(make, generator):
    truth, frame = lights_of(generator), make.rotation(generator)
    ours = truth.clone()
    ours[:, 1:] = truth[:, 1:] @ frame  # world_from_truth is the transpose
    found = compare_lights(ours, truth, frame)
    assert found.mean_deg < 1e-6
    assert compare_lights(ours, truth, frame.mT).mean_deg > 1


def test_mirrored_lights_are_not_aligned_by_a_reflection(generator):
    truth = lights_of(generator)
    ours = truth * truth.new_tensor([1.0, 1.0, 1.0, -1.0])
    found = compare_lights(ours, truth, torch.eye(3).double())
    assert found.mean_rotated_deg > 10


def test_unknown_lights_are_excluded(generator):
    truth = lights_of(generator, 4)
    ours = truth.clone()
    ours[0], ours[1, 1:] = torch.nan, 0
    found = compare_lights(ours, truth, torch.eye(3).double())
    assert found.lights == 2
    assert found.mean_deg < 1e-6
    assert compare_lights(ours[:2], truth[:2], torch.eye(3).double()) is None


def cloud(points):
    return Mesh(vertices_world=points, faces=torch.zeros(0, 3, dtype=torch.long))


def cloud_diagonal(points):
    return float((points.amax(dim=0) - points.amin(dim=0)).norm())


def test_a_rotated_and_shifted_camera_has_that_error(make, generator):
    truth = make.cameras()
    ours = truth.cam_from_world.clone()
    # Rotate camera 2 about its centre by 3 degrees, and shift camera 4 by 0.5.
    ours[2] = rigid(make.rotation(generator, 3.0), torch.zeros(3).double()) @ ours[2]
    ours[4, 0, 3] += 0.5
    cameras = truth.replace(
        cam_from_world=ours,
        intrinsics=truth.intrinsics * truth.intrinsics.new_tensor([1.1, 1.1, 1])[:, None],
    )
    corners = torch.tensor([[-1.0, 0, 0], [1.0, 0, 0]]).double()
    found = compare_cameras(cameras, truth, IDENTITY, views=7, surface=cloud(corners))
    assert (found.views, found.missing) == (7, 2)
    assert found.mean_rotation_deg == pytest.approx(3 / 5)
    assert found.median_rotation_deg == pytest.approx(0, abs=1e-6)
    assert found.mean_center == pytest.approx(0.1)
    assert found.mean_center_percent == pytest.approx(100 * 0.1 / 5)  # 5 from the centre
    assert found.mean_focal_percent == pytest.approx(10.0)


def test_cameras_in_a_different_frame_have_no_error_after_alignment(make, generator):
    truth = make.cameras()
    rotation = make.rotation(generator)
    ours = make.transferred(truth, 0.2, rotation, torch.tensor([1.0, 2.0, 3.0]).double())
    ours = ours.replace(
        intrinsics=ours.intrinsics * ours.intrinsics.new_tensor([0.5, 0.5, 1])[:, None],
        sizes_px=ours.sizes_px // 2,
    )
    found = compare_cameras(ours, truth, similarity_between_cameras(ours, truth), views=5)
    assert found.mean_rotation_deg < 1e-5
    assert found.mean_center < 1e-8
    assert found.mean_focal_percent < 1e-8
    assert found.mean_center_percent != found.mean_center_percent  # the centre is unknown


def test_positions_separate_the_similarity_from_the_deformation(make, generator):
    truth = make.cameras()
    points = torch.rand(60, 3, generator=generator, dtype=torch.float64) - 0.5
    points[:2] = torch.tensor([[-1.0, 0, 0], [1.0, 0, 0]])  # a diagonal slightly above 2
    shift = torch.eye(4).double()
    shift[0, 3] = 0.02
    found = compare_cameras(truth, truth, shift, views=5, surface=cloud(points))
    assert found.mean_position_percent == pytest.approx(2 / cloud_diagonal(points))
    assert found.mean_bend_percent < 1e-9
    longer = truth.replace(
        intrinsics=truth.intrinsics * truth.intrinsics.new_tensor([1.05, 1.05, 1])[:, None]
    )
    found = compare_cameras(longer, truth, IDENTITY, views=5, surface=cloud(points))
    assert found.mean_bend_percent > 0.01
    assert found.mean_position_percent > found.mean_bend_percent


def test_positions_of_resized_photographs_are_compared_in_their_pixels(make, generator):
    truth = make.cameras()
    points = torch.rand(60, 3, generator=generator, dtype=torch.float64) - 0.5
    half = truth.replace(
        intrinsics=truth.intrinsics * truth.intrinsics.new_tensor([0.5, 0.5, 1])[:, None],
        sizes_px=truth.sizes_px // 2,
    )
    found = compare_cameras(half, truth, IDENTITY, views=5, surface=cloud(points))
    assert found.mean_position_percent < 1e-9


def test_positions_are_unknown_without_an_object(make):
    found = compare_cameras(make.cameras(), make.cameras(), IDENTITY, views=5)
    assert found.mean_position_percent != found.mean_position_percent
