"""Labels that initialize the cut of a view, on synthetic images."""

import pytest
import torch

from pimper_torch.geometry.opencv import (
    BACKGROUND,
    OBJECT,
    PERHAPS_BACKGROUND,
    PERHAPS_OBJECT,
    signed_distance,
)
from pimper_torch.stages.silhouettes.cuts import (
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
    """Return agreement with the plane, which is visible except at occluders."""
    return torch.where(hidden, -0.2, 0.95)


@pytest.fixture
def thing() -> torch.Tensor:
    return square(100, 80, 200, 180)


def test_points_label_discs_and_object_overrides_background(thing):
    points, others = torch.tensor([[150.5, 130.5]]), torch.tensor([[20.5, 20.5]])
    labels = labels_from_points(points, others, None, (WIDTH, HEIGHT))
    assert labels[130, 150] == OBJECT
    assert labels[20, 20] == BACKGROUND
    assert labels[20, 40] == PERHAPS_BACKGROUND
    assert (labels[0] == BACKGROUND).all()  # the strip along the border
    assert (labels[:, -1] == BACKGROUND).all()


def test_the_plane_next_to_the_object_is_background_except_a_seam(thing):
    labels = labels_from_points(NOTHING, NOTHING, agreeing(thing), (WIDTH, HEIGHT))
    assert labels[130, 20] == BACKGROUND
    assert labels[130, 99] == PERHAPS_BACKGROUND  # the foot of an object also agrees with the plane
    assert labels[130, 150] != BACKGROUND


def test_windows_that_agree_with_the_plane_are_not_certainly_object(thing):
    """Windows across the border of the object agree less: they contain plane."""
    corners = torch.tensor([[60.5, 60.5], [240.5, 60.5], [240.5, 200.5], [60.5, 200.5]])
    labels = labels_from_points(corners, NOTHING, agreeing(thing), (WIDTH, HEIGHT))
    assert labels[130, 101] == PERHAPS_BACKGROUND  # half a window of 320 / 80 pixels
    assert labels[130, 103] == PERHAPS_OBJECT
    assert not not_seen_through(corners, agreeing(thing))[130, 101]
    assert not_seen_through(corners, agreeing(thing))[130, 103]


def test_gaps_that_show_the_plane_are_background():
    legs = square(100, 80, 130, 180) | square(145, 80, 175, 180)
    hull = square(100, 80, 175, 180)
    margin = torch.where(hull, 1.0, -1.0)
    labels = labels_from_hull(margin, hull, NOTHING, agreeing(legs))
    assert labels[130, 137] == BACKGROUND
    assert labels[130, 115] == PERHAPS_OBJECT


def test_parallax_suffices_inside_the_hull_but_not_far_outside(thing):
    margin = torch.where(thing, 20.0, -20.0)
    labels = labels_from_hull(margin, thing, NOTHING, agreeing(thing))
    assert labels[130, 150] == OBJECT
    unknown = torch.full((HEIGHT, WIDTH), torch.nan)
    labels = labels_from_hull(margin, thing, NOTHING, unknown)
    assert labels[130, 150] == PERHAPS_OBJECT
    assert labels[10, 10] == BACKGROUND


def test_pixels_that_disagree_are_off_the_plane_except_grains(thing):
    grain = square(20, 20, 22, 22)
    found = off_plane_mask(agreeing(thing | grain))
    assert found[130, 150]
    assert not found[20:22, 20:22].any()
    assert not off_plane_mask(torch.full((HEIGHT, WIDTH), torch.nan)).any()


def test_wide_off_plane_regions_outside_the_object_are_occluders(thing):
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
def test_holes_are_filled_unless_they_show_the_plane(thing, seen_through):
    hole = square(140, 120, 160, 140)
    cut = thing & ~hole
    agreement = agreeing(thing & ~hole) if seen_through else agreeing(thing)
    assert bool(filled(cut, agreement)[130, 150]) != seen_through


def test_the_exposed_fraction_counts_visible_plane_except_a_seam():
    agreement = torch.ones(200, 400)
    agreement[:, :200] = torch.nan
    cut = torch.zeros(200, 400, dtype=torch.bool)
    cut[50:150, 100:300] = True
    assert 0.47 < float(exposed_fraction(cut, agreement)) < 0.5
    assert float(exposed_fraction(cut, torch.zeros(200, 400))) == 0
    assert float(exposed_fraction(cut, None)) == 0
    assert float(exposed_fraction(~cut & cut, agreement)) == 0


def test_the_held_fraction_counts_points_and_needs_enough():
    cut = torch.zeros(20, 30, dtype=torch.bool)
    cut[:, :10] = True
    points = torch.stack([torch.arange(0.5, 30, 1.0), torch.full((30,), 7.5)], dim=1)
    assert float(held_fraction(cut, points)) == pytest.approx(1 / 3)
    assert float(held_fraction(cut, points[20:])) == 1  # ten


def test_the_medial_axis_of_a_thin_part_is_object_and_a_streak_is_not(thing):
    leg, streak = square(120, 180, 130, 220), square(160, 180, 163, 220)
    shape = thing | leg | streak
    labels = labels_from_hull(signed_distance(shape), thing, NOTHING, agreeing(shape))
    assert (labels[190:210, 124:126] == OBJECT).all()
    assert not (labels[185:, :122] == OBJECT).any()
    assert not (labels[185:, 128:] == OBJECT).any()


def test_unknown_votes_leave_pixels_outside_the_hull_uncertain(thing):
    unknown, margin = square(0, 0, WIDTH, 40), signed_distance(thing)
    agreement = agreeing(thing).masked_fill(unknown, torch.nan)
    labels = labels_from_hull(margin, thing, NOTHING, agreement, unknown)
    assert (labels[:40][margin[:40] < -20] == PERHAPS_BACKGROUND).all()
    without = labels_from_hull(margin, thing, NOTHING, agreement)
    assert (without[:40] == BACKGROUND).all()
    assert torch.equal(labels[40:], without[40:])
