import pytest
import torch
from torch.testing import assert_close

from pimper_torch.ground.geometry.projection import project
from pimper_torch.method.sfm.camera_in_place import (
    fit_map,
    least_squares_map,
    mapped,
    reference_from_photographs,
    shift_px,
)
from tests.sfm.captured import Captured, orbit, panned, seen_of_ball, turntable


def reference_of(scene):
    return reference_from_photographs(
        scene.keypoints,
        scene.pairs,
        max_error_px=2.0,
        fewest=15,
        generator=torch.Generator().manual_seed(2),
    )


def lengths(scene, maps):
    """Give how far right matches are from still once mapped, of what turns and of the room."""
    found = [], []
    for pair, rows in scene.pairs.items():
        first, second = rows[scene.right(pair, rows)].unbind(dim=1)
        ends = (
            mapped(maps[pair[0]], scene.keypoints[pair[0]][first]),
            mapped(maps[pair[1]], scene.keypoints[pair[1]][second]),
        )
        length = (ends[0] - ends[1]).norm(dim=1)
        room = scene.thing[pair[0]][first] >= 500
        found[0].append(length[~room])
        found[1].append(length[room])
    return tuple(torch.cat(part) for part in found)


# A table that turns along moves by homographies, too, and has as many features as the room.
@pytest.mark.parametrize(("largest_px", "table"), [(5.0, 250), (150.0, 0)])
def test_a_room_that_shifts_is_brought_back_and_what_turns_is_not(generator, largest_px, table):
    scene = turntable(generator, shift_px=largest_px, table=table)
    maps = reference_of(scene)
    assert shift_px(maps, scene.keypoints) > 0.4 * largest_px
    turning, room = lengths(scene, maps)
    assert room.median() < 0.5  # noise of 0.2 px in both coordinates of both ends
    assert (room < 2).double().mean() > 0.99
    assert (turning < 2).double().mean() < 0.05


def test_what_most_neighbours_show_does_not_hide_a_room_with_few_features(generator):
    scene = turntable(generator, resting=60, count=24, shift_px=60.0)
    turning, room = lengths(scene, reference_of(scene))
    assert (room < 2).double().mean() > 0.99
    assert (turning < 2).double().mean() < 0.05


def test_a_room_exactly_at_rest_is_no_case_for_maps(generator):
    assert reference_of(turntable(generator)) is None


def test_a_camera_that_goes_round_has_no_reference(generator):
    cameras = orbit(12, 330.0)
    points = 6 * torch.rand(400, 3, generator=generator, dtype=torch.float64) - 3
    points[:, 2] = -1
    ball = seen_of_ball(generator, 400, cameras)
    flat, _ = project(points, cameras.cam_from_world, cameras.intrinsics)
    assert reference_of(Captured(generator, torch.cat([ball, flat], dim=1))) is None
    assert reference_of(Captured(generator, panned(generator, flat, 40.0))) is None


def test_a_map_is_found_among_matches_of_which_four_in_five_follow_none(generator):
    first = 600 * torch.rand(500, 2, generator=generator, dtype=torch.float64)
    (true,) = [torch.tensor([[1.02, -0.03, 90.0], [0.03, 1.02, -40.0], [8e-5, -5e-5, 1.0]])]
    second = mapped(true.double(), first)
    second[100:] = 600 * torch.rand(400, 2, generator=generator, dtype=torch.float64)
    found, follows = fit_map(first, second, first.new_tensor([300.0, 300.0]), 2.0, generator)
    assert follows[:100].all()
    assert follows[100:].double().mean() < 0.02
    corners = first.new_tensor([[0.0, 0], [600, 0], [0, 600], [600, 600]])
    assert_close(mapped(found, corners), mapped(true.double(), corners), atol=0.5, rtol=0)


def test_a_picture_that_rolls_far_is_no_camera_in_its_place(generator):
    first = 600 * torch.rand(50, 2, generator=generator, dtype=torch.float64)
    angle = torch.tensor(-0.6, dtype=torch.float64)
    second = first @ torch.stack([angle.cos(), angle.sin(), -angle.sin(), angle.cos()]).view(2, 2)
    assert fit_map(first, second, first.new_tensor([300.0, 300.0]), 2.0, generator) is None


def test_least_squares_maps_are_those_that_made_the_matches(generator):
    first = 600 * torch.rand(20, 2, generator=generator, dtype=torch.float64)
    centre = first.new_tensor([300.0, 200.0])
    around = torch.eye(3, dtype=torch.float64)
    around[:2, 2] = -centre
    any_map = torch.tensor([[1.1, -0.2, 30.0], [0.1, 0.9, -20.0], [1e-4, -2e-4, 1.0]]).double()
    similar = torch.tensor([[1.1, -0.2, 30.0], [0.2, 1.1, -20.0], [1e-4, -2e-4, 1.0]]).double()
    similar = around.inverse() @ similar @ around
    for true, about in ((any_map, None), (similar, centre), (similar, None)):
        found = least_squares_map(first, mapped(true, first), about)
        assert_close(found / found[2, 2], true / true[2, 2])
    found = least_squares_map(first, mapped(any_map, first), centre)
    assert (mapped(found, first) - mapped(any_map, first)).norm(dim=1).max() > 5
