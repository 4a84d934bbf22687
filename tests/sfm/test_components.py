import pytest
import torch

from pimper_torch.ground.geometry.rigid import rigid
from pimper_torch.method.sfm.doubt import choose_component, count_spread_views
from pimper_torch.runtime.errors import ReconstructionError

NAMES = tuple(f"{index:02d}.jpg" for index in range(20))


def test_the_largest_component_is_kept_when_it_is_a_clear_majority():
    assert choose_component([NAMES[:4], NAMES[4:20]], [4, 16], NAMES, 0.6) == 1


def test_a_small_model_without_a_rival_is_kept():
    assert choose_component([NAMES[:5]], [5], NAMES, 0.6) == 0


def test_a_component_inside_the_largest_one_is_no_rival():
    assert choose_component([NAMES[:8], NAMES[2:8]], [8, 6], NAMES, 0.6) == 0


def test_a_split_in_halves_is_refused_with_sizes_names_and_advice():
    with pytest.raises(ReconstructionError) as caught:
        choose_component([NAMES[:9], NAMES[9:16]], [9, 7], NAMES, 0.6)
    message = str(caught.value)
    assert "split 20 photographs into 2 models" in message
    assert "9 photographs (00.jpg" in message
    assert "7 photographs (09.jpg" in message
    assert "add photographs between" in message
    assert "turned over" in message
    assert "sides from low down in every series" in message


@pytest.mark.parametrize("parts", [[], [NAMES[:2]], [NAMES[:2], NAMES[2:4]]])
def test_fewer_than_three_views_are_refused_with_how_many_and_which(parts):
    with pytest.raises(ReconstructionError, match="at least 3 are needed") as caught:
        choose_component(parts, [len(part) for part in parts], NAMES[:6], 0.6)
    message = str(caught.value)
    assert f"registered {len(parts[0]) if parts else 0} of 6 photographs" in message
    assert "05.jpg" in message
    assert ("00.jpg" in message) == (not parts)


def test_the_component_that_sees_depth_is_kept_before_a_larger_one_that_does_not():
    assert choose_component([NAMES, NAMES[:13]], [0, 13], NAMES, 0.6) == 1
    # What lies on the background is no rival, even to less than the majority.
    assert choose_component([NAMES, NAMES[:7]], [2, 7], NAMES, 0.6) == 1


def test_cameras_in_one_place_are_refused_with_what_happened_and_what_to_do():
    with pytest.raises(ReconstructionError) as caught:
        choose_component([NAMES], [0], NAMES, 0.6)
    message = str(caught.value)
    assert "registered 20 of 20 photographs, but only 0 of them see" in message
    assert "background at rest" in message
    for way in ("masks", "plain cloth", "move the camera"):
        assert way in message


def test_a_view_counts_if_enough_of_its_points_are_seen_from_aside(model):
    assert count_spread_views(model, 10) == 5
    assert count_spread_views(model, 41) == 0  # more than there are
    rotated = model.cam_from_world[:, :3, :3]
    behind = torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64).expand(5, 3)
    one_place = rigid(rotated, (rotated @ behind[..., None])[..., 0])
    assert count_spread_views(model.replace(cam_from_world=one_place), 10) == 0
    # Four views in one place and one aside: only what the one sees has an angle.
    aside = one_place.clone()
    aside[4, :3, 3] += aside.new_tensor([2.0, 0.0, 0.0])
    alone = model.observation_view != 4
    assert count_spread_views(model.replace(cam_from_world=aside), 10) == 5
    assert count_spread_views(model.replace(cam_from_world=aside).without(~alone), 10) == 0
