import pytest
import torch
from torch.testing import assert_close

from pimper_torch.ground.geometry.pixels import pixel_centers
from pimper_torch.method.silhouettes.cuts import repaired
from pimper_torch.method.silhouettes.reliability import agreement_of
from tests.silhouettes import shapes

VIEWS = 8


def disc(center=(50.0, 40.0), radius=25.0):
    """Distances inside a disc in a picture of 100 x 80 pixels."""
    away = pixel_centers(100, 80, like=torch.ones(())) - torch.tensor(center)
    return radius - away.norm(dim=-1)


MARGINS = disc().expand(VIEWS, 80, 100)
CAST = disc((72.0, 52.0), 9.0) > 0
SHADOWED = (disc() > 0) | CAST
"""The disc, and what it casts on the ground beside it."""


def cuts_of(changed):
    """Cuts that agree with the projection of a disc, the first ones replaced."""
    masks = MARGINS > 0
    return torch.cat([torch.stack(changed), masks[len(changed) :]])


def with_dark(where):
    """A twentieth of the radiance in some places, in all views."""
    return (-3.0 * where).expand(VIEWS, 80, 100)


@pytest.mark.parametrize("count", [1, 5])
def test_shadows_that_the_hull_denies_are_taken_from_cuts(count):
    """From one, or from most of them, as under a hard lamp."""
    cuts = cuts_of([SHADOWED] * count)
    found = repaired(cuts, MARGINS, with_dark(CAST))
    # Half of the excess' least depth, 0.5 pixels, stays along the border of what is taken.
    assert not (found[:count] & (disc() < -0.25)).any()
    assert (found | ~(disc() > 0)).all()
    assert torch.equal(found[count:], cuts[count:])


def test_the_shadow_of_an_object_as_dark_as_shadows_is_taken():
    cuts = cuts_of([SHADOWED] * 5)
    found = repaired(cuts, MARGINS, with_dark(SHADOWED))
    assert not (found[:5] & (disc() < -0.25)).any()
    assert (found | ~(disc() > 0)).all()


def test_the_dark_side_of_the_object_stays():
    """It is inside the hull, and half a pixel outside denies nothing."""
    cuts = cuts_of([disc() > -0.4])
    left = pixel_centers(100, 80, like=torch.ones(()))[..., 0] < 50
    assert torch.equal(repaired(cuts, MARGINS, with_dark(left)), cuts)


@pytest.mark.parametrize(
    ("changed", "dark"),
    [
        ([SHADOWED], None),  # no plane for a shadow to fall on
        ([SHADOWED] * 5, CAST & False),  # as bright as the object: the hull has lost it
        ([disc((53.0, 40.0)) > 0], CAST & False),  # a misplaced camera
        ([disc() < -100], CAST),  # a cut of nothing
    ],
)
def test_nothing_is_taken_where_another_cause_is_likelier(changed, dark):
    cuts = cuts_of(changed)
    grey = None if dark is None else with_dark(dark)
    assert torch.equal(repaired(cuts, MARGINS, grey), cuts)


def test_a_highlight_is_filled_where_the_hull_is_deep_and_no_plane_tells_of_it():
    """A hole beside the border, which the projection is not deep around, may be one."""
    holes = disc() > 0
    holes &= (disc((50.0, 40.0), 4.0) < 0) & (disc((50.0, 60.5), 2.0) < 0)
    open_side = holes | (disc((50.0, 40.0), 4.0) >= 0)
    assert torch.equal(repaired(cuts_of([holes]), MARGINS, None)[0], open_side)
    assert torch.equal(repaired(cuts_of([holes]), MARGINS, with_dark(CAST))[0], holes)


def test_the_agreement_counts_pixels():
    square = torch.full((80, 100), -1.0)
    square[10:50, 10:50] = 1.0
    cut = torch.zeros(80, 100, dtype=torch.bool)
    cut[10:50, 30:70] = True  # half of it inside
    margins = square.expand(VIEWS, 80, 100)
    masks = torch.cat([torch.stack([cut, torch.zeros_like(cut)]), margins[2:] > 0])
    overlap, reliable = agreement_of(shapes.cuts_of(masks, margins))
    assert_close(overlap[:3], torch.tensor([1 / 3, 0, 1], dtype=torch.float64))
    assert reliable.tolist() == [False, False] + [True] * 6


def test_cuts_that_agree_with_one_another_and_not_with_the_rest_are_not_reliable():
    cuts = shapes.cuts_of(MARGINS > 0, MARGINS)
    exposed = torch.tensor([0.0, 0.005, 0.02, 1.0, 0.0, 0.0, 0.0, 0.0]).double()
    held = torch.tensor([1.0, 0.95, 1.0, 1.0, 0.95, 0.8, 0.0, 1.0]).double()
    overlap, reliable = agreement_of(cuts.replace(exposed=exposed, held=held))
    assert (overlap > 0.9).all()
    assert reliable.nonzero()[:, 0].tolist() == [0, 1, 4, 7]
