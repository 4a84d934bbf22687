"""What is labelled before a view is cut, on pictures that are drawn."""

import pytest
import torch

from pimper_torch.ground.geometry.opencv import (
    BACKGROUND,
    OBJECT,
    PERHAPS_BACKGROUND,
    PERHAPS_OBJECT,
    signed_distance,
)
from pimper_torch.method.silhouettes.cuts import (
    exposed_fraction,
    filled,
    held_fraction,
    labels_from_hull,
    labels_from_points,
    not_seen_through,
    occluder_mask,
    off_plane_mask,
)

WIDTH, HEIGHT = 320, 240
NOTHING = torch.zeros(0, 2)


def square(left: int, top: int, right: int, bottom: int) -> torch.Tensor:
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[top:bottom, left:right] = True
    return mask


def agreeing(hidden: torch.Tensor) -> torch.Tensor:
    """The plane is seen but where something stands before it."""
    return torch.where(hidden, -0.2, 0.95)


@pytest.fixture
def thing() -> torch.Tensor:
    return square(100, 80, 200, 180)


def test_points_label_discs_about_them_and_background_wins_nothing_from_the_object(thing):
    points, others = torch.tensor([[150.5, 130.5]]), torch.tensor([[20.5, 20.5]])
    labels = labels_from_points(points, others, None, (WIDTH, HEIGHT))
    assert labels[130, 150] == OBJECT
    assert labels[20, 20] == BACKGROUND
    assert labels[20, 40] == PERHAPS_BACKGROUND
    assert (labels[0] == BACKGROUND).all()  # the strip along the border
    assert (labels[:, -1] == BACKGROUND).all()


def test_the_plane_beside_the_object_is_background_but_for_a_seam(thing):
    labels = labels_from_points(NOTHING, NOTHING, agreeing(thing), (WIDTH, HEIGHT))
    assert labels[130, 20] == BACKGROUND
    assert labels[130, 99] == PERHAPS_BACKGROUND  # an object's foot agrees with the plane, too
    assert labels[130, 150] != BACKGROUND


def test_what_a_window_holds_that_agrees_is_not_the_object_for_certain(thing):
    """Windows that reach over the border of the object agree less: the plane goes on there."""
    corners = torch.tensor([[60.5, 60.5], [240.5, 60.5], [240.5, 200.5], [60.5, 200.5]])
    labels = labels_from_points(corners, NOTHING, agreeing(thing), (WIDTH, HEIGHT))
    assert labels[130, 101] == PERHAPS_BACKGROUND  # half a window of 320 / 80 pixels
    assert labels[130, 103] == PERHAPS_OBJECT
    assert not not_seen_through(corners, agreeing(thing))[130, 101]
    assert not_seen_through(corners, agreeing(thing))[130, 103]


def test_gaps_between_legs_are_background_where_the_plane_is_seen_in_them():
    legs = square(100, 80, 130, 180) | square(145, 80, 175, 180)
    hull = square(100, 80, 175, 180)
    margin = torch.where(hull, 1.0, -1.0)
    labels = labels_from_hull(margin, hull, NOTHING, agreeing(legs))
    assert labels[130, 137] == BACKGROUND
    assert labels[130, 115] == PERHAPS_OBJECT


def test_deep_inside_the_hull_parallax_is_enough_and_far_beyond_it_nothing_is(thing):
    margin = torch.where(thing, 20.0, -20.0)
    labels = labels_from_hull(margin, thing, NOTHING, agreeing(thing))
    assert labels[130, 150] == OBJECT
    unknown = torch.full((HEIGHT, WIDTH), torch.nan)
    labels = labels_from_hull(margin, thing, NOTHING, unknown)
    assert labels[130, 150] == PERHAPS_OBJECT
    assert labels[10, 10] == BACKGROUND


def test_what_does_not_show_the_plane_is_off_it_and_grains_are_not(thing):
    grain = square(20, 20, 22, 22)
    found = off_plane_mask(agreeing(thing | grain))
    assert found[130, 150]
    assert not found[20:22, 20:22].any()
    assert not off_plane_mask(torch.full((HEIGHT, WIDTH), torch.nan)).any()


def test_what_is_wide_and_off_the_plane_but_not_the_object_stands_before_it(thing):
    person, halo = square(200, 40, 240, 240), square(95, 75, 205, 185)
    agreement = agreeing(thing | person | halo)
    agreement[100:140, 210:214] = 0.9  # a grain
    found = occluder_mask(thing, agreement)
    assert found[60:230, 205:235].all()
    assert not (found & thing).any()
    assert not found[:, :195].any()
    assert not occluder_mask(thing, agreeing(thing | halo)).any()
    assert not occluder_mask(thing, torch.full((HEIGHT, WIDTH), torch.nan)).any()


@pytest.mark.parametrize("seen_through", [False, True])
def test_holes_are_filled_unless_the_plane_is_seen_through_them(thing, seen_through):
    hole = square(140, 120, 160, 140)
    cut = thing & ~hole
    agreement = agreeing(thing & ~hole) if seen_through else agreeing(thing)
    assert bool(filled(cut, agreement)[130, 150]) != seen_through


def test_a_cut_exposes_what_it_shows_of_the_plane_but_for_a_seam():
    agreement = torch.ones(200, 400)
    agreement[:, :200] = torch.nan
    cut = torch.zeros(200, 400, dtype=torch.bool)
    cut[50:150, 100:300] = True
    assert 0.47 < float(exposed_fraction(cut, agreement)) < 0.5
    assert float(exposed_fraction(cut, torch.zeros(200, 400))) == 0
    assert float(exposed_fraction(cut, None)) == 0
    assert float(exposed_fraction(~cut & cut, agreement)) == 0


def test_a_cut_holds_the_points_in_it_and_a_few_points_tell_nothing():
    cut = torch.zeros(20, 30, dtype=torch.bool)
    cut[:, :10] = True
    points = torch.stack([torch.arange(0.5, 30, 1.0), torch.full((30,), 7.5)], dim=1)
    assert float(held_fraction(cut, points)) == pytest.approx(1 / 3)
    assert float(held_fraction(cut, points[20:])) == 1  # ten


def test_the_middle_of_a_thin_part_is_the_objects_and_a_shadows_edge_is_not(thing):
    leg, streak = square(120, 180, 130, 220), square(160, 180, 163, 220)
    shape = thing | leg | streak
    labels = labels_from_hull(signed_distance(shape), thing, NOTHING, agreeing(shape))
    assert (labels[190:210, 124:126] == OBJECT).all()
    assert not (labels[185:, :122] == OBJECT).any()
    assert not (labels[185:, 128:] == OBJECT).any()


def test_where_the_vote_was_unknown_nothing_is_certain_outside_the_hull(thing):
    unknown, margin = square(0, 0, WIDTH, 40), signed_distance(thing)
    agreement = agreeing(thing).masked_fill(unknown, torch.nan)
    labels = labels_from_hull(margin, thing, NOTHING, agreement, unknown)
    assert (labels[:40][margin[:40] < -20] == PERHAPS_BACKGROUND).all()
    without = labels_from_hull(margin, thing, NOTHING, agreement)
    assert (without[:40] == BACKGROUND).all()
    assert torch.equal(labels[40:], without[40:])
