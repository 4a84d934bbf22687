import pytest
import torch
from torch.testing import assert_close

from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.stages.silhouettes.cuts import repaired
from pimper_torch.stages.silhouettes.reliability import agreement_of
from tests.silhouettes import shapes

VIEWS = 8


def disc(center=(50.0, 40.0), radius=25.0):
    """Return distances inside a disc in an image of 100 x 80 pixels."""
    away = pixel_centers(100, 80, like=torch.ones(())) - torch.tensor(center)
    return radius - away.norm(dim=-1)


MARGINS = disc().expand(VIEWS, 80, 100)
CAST = disc((72.0, 52.0), 9.0) > 0
SHADOWED = (disc() > 0) | CAST
"""The disc and its cast shadow on the ground."""


def cuts_of(changed):
    """Return cuts that agree with the projection of a disc; the first ones are replaced."""
    masks = MARGINS > 0
    return torch.cat([torch.stack(changed), masks[len(changed) :]])


def with_dark(where):
    """Return log radiance that falls to a twentieth in a region, in all views."""
    return (-3.0 * where).expand(VIEWS, 80, 100)


@pytest.mark.parametrize("count", [1, 5])
def test_shadows_outside_the_hull_are_removed_from_cuts(count):
    """From one or most cuts, as under a hard light."""
    cuts = cuts_of([SHADOWED] * count)
    found = repaired(cuts, MARGINS, with_dark(CAST))
    # Half of the least excess, 0.5 pixels, remains along the border of removed regions.
    assert not (found[:count] & (disc() < -0.25)).any()
    assert (found | ~(disc() > 0)).all()
    assert torch.equal(found[count:], cuts[count:])


def test_the_shadow_of_a_dark_object_is_removed():
    cuts = cuts_of([SHADOWED] * 5)
    found = repaired(cuts, MARGINS, with_dark(SHADOWED))
    assert not (found[:5] & (disc() < -0.25)).any()
    assert (found | ~(disc() > 0)).all()


def test_the_dark_side_of_the_object_is_kept():
    """It is inside the hull; half a pixel outside is no contradiction."""
    cuts = cuts_of([disc() > -0.4])
    left = pixel_centers(100, 80, like=torch.ones(()))[..., 0] < 50
    assert torch.equal(repaired(cuts, MARGINS, with_dark(left)), cuts)


@pytest.mark.parametrize(
    ("changed", "dark"),
    [
        ([SHADOWED], None),  # no plane that receives a shadow
        ([SHADOWED] * 5, CAST & False),  # as bright as the object: the hull lacks it
        ([disc((53.0, 40.0)) > 0], CAST & False),  # a misplaced camera
        ([disc() < -100], CAST),  # an empty cut
    ],
)
def test_pixels_with_a_likelier_cause_are_kept(changed, dark):
    cuts = cuts_of(changed)
    grey = None if dark is None else with_dark(dark)
    assert torch.equal(repaired(cuts, MARGINS, grey), cuts)


def test_a_highlight_is_filled_inside_the_hull_unless_the_plane_shows():
    """A hole next to the border, where the hull is not deep, may be real."""
    holes = disc() > 0
    holes &= (disc((50.0, 40.0), 4.0) < 0) & (disc((50.0, 60.5), 2.0) < 0)
    open_side = holes | (disc((50.0, 40.0), 4.0) >= 0)
    assert torch.equal(repaired(cuts_of([holes]), MARGINS, None)[0], open_side)
    assert torch.equal(repaired(cuts_of([holes]), MARGINS, with_dark(CAST))[0], holes)


def test_agreement_is_an_overlap_of_pixels():
    square = torch.full((80, 100), -1.0)
    square[10:50, 10:50] = 1.0
    cut = torch.zeros(80, 100, dtype=torch.bool)
    cut[10:50, 30:70] = True  # half is inside
    margins = square.expand(VIEWS, 80, 100)
    masks = torch.cat([torch.stack([cut, torch.zeros_like(cut)]), margins[2:] > 0])
    overlap, reliable = agreement_of(shapes.cuts_of(masks, margins))
    assert_close(overlap[:3], torch.tensor([1 / 3, 0, 1], dtype=torch.float64))
    assert reliable.tolist() == [False, False] + [True] * 6


def test_a_consistent_minority_of_cuts_is_not_reliable():
    cuts = shapes.cuts_of(MARGINS > 0, MARGINS)
    exposed = torch.tensor([0.0, 0.005, 0.02, 1.0, 0.0, 0.0, 0.0, 0.0]).double()
    held = torch.tensor([1.0, 0.95, 1.0, 1.0, 0.95, 0.8, 0.0, 1.0]).double()
    overlap, reliable = agreement_of(cuts.replace(exposed=exposed, held=held))
    assert (overlap > 0.9).all()
    assert reliable.nonzero()[:, 0].tolist() == [0, 1, 4, 7]
