import pytest
import torch
from torch.testing import assert_close

from pimper_torch.ground.geometry.pixels import pixel_centers
from pimper_torch.method.silhouettes.reliability import agreement_of, repaired
from tests.silhouettes import shapes

VIEWS = 8


def disc(center=(50.0, 40.0), radius=25.0):
    """Distances inside a disc in a picture of 100 x 80 pixels."""
    away = pixel_centers(100, 80, like=torch.ones(())) - torch.tensor(center)
    return radius - away.norm(dim=-1)


def cuts_of(changed, on_plane=True, margin=None):
    """Cuts that agree with the projection of a disc, the first ones replaced."""
    margins = (disc() if margin is None else margin).expand(VIEWS, 80, 100)
    masks = margins > 0
    masks = torch.cat([torch.stack(changed), masks[len(changed) :]])
    return shapes.cuts_of(masks, margins, on_plane)


def shadowed():
    """The disc, and what it casts on the ground beside it."""
    return (disc() > 0) | (disc((72.0, 52.0), 9.0) > 0)


def test_what_one_view_cuts_and_the_hull_denies_is_taken_from_it():
    cuts = cuts_of([shadowed()])
    found = repaired(cuts).masks
    # Half of _FAR times 100 pixels stays along the border of what is taken.
    assert torch.equal(found[0] & (disc() < -0.25), torch.zeros(80, 100, dtype=torch.bool))
    assert torch.equal(found[0] & (disc() > 0), disc() > 0)
    assert torch.equal(found[1:], cuts.masks[1:])


def test_what_lies_apart_from_the_excess_keeps_its_border():
    """A pixel too wide on the far side is no shadow."""
    wide = (disc() > -0.4) | shadowed()
    found = repaired(cuts_of([wide])).masks[0]
    far_side = torch.zeros(80, 100, dtype=torch.bool)
    far_side[:, :40] = True
    far_side &= disc() > -0.25
    assert (found & far_side).sum() == far_side.sum()


@pytest.mark.parametrize(
    ("changed", "on_plane"),
    [
        ([shadowed()], False),  # no plane for a shadow to fall on
        ([shadowed()] * 5, True),  # most views see it: the hull has lost it
        ([disc((53.0, 40.0)) > 0], True),  # a misplaced camera
        ([disc((50.0, 40.0), 32.0) > 0], True),  # has little to do with the projection
    ],
)
def test_nothing_is_taken_where_another_cause_is_likelier(changed, on_plane):
    cuts = cuts_of(changed, on_plane)
    assert torch.equal(repaired(cuts).masks, cuts.masks)


def test_a_highlight_is_filled_where_the_hull_is_deep_and_no_plane_tells_of_it():
    """A hole beside the border, which the projection is not deep around, may be one."""
    holes = disc() > 0
    holes &= (disc((50.0, 40.0), 4.0) < 0) & (disc((50.0, 60.5), 2.0) < 0)
    open_side = holes | (disc((50.0, 40.0), 4.0) >= 0)
    assert torch.equal(repaired(cuts_of([holes], on_plane=False)).masks[0], open_side)
    assert torch.equal(repaired(cuts_of([holes], on_plane=True)).masks[0], holes)


def test_the_agreement_counts_pixels():
    square = torch.full((80, 100), -1.0)
    square[10:50, 10:50] = 1.0
    cut = torch.zeros(80, 100, dtype=torch.bool)
    cut[10:50, 30:70] = True  # half of it inside
    overlap, reliable = agreement_of(cuts_of([cut, torch.zeros_like(cut)], margin=square))
    assert_close(overlap[:3], torch.tensor([1 / 3, 0, 1], dtype=torch.float64))
    assert reliable.tolist() == [False, False] + [True] * 6


def test_cuts_that_agree_with_one_another_and_not_with_the_rest_are_not_reliable():
    cuts = cuts_of([disc() > 0])
    exposed = torch.tensor([0.0, 0.005, 0.02, 1.0, 0.0, 0.0, 0.0, 0.0]).double()
    held = torch.tensor([1.0, 0.95, 1.0, 1.0, 0.95, 0.8, 0.0, 1.0]).double()
    overlap, reliable = agreement_of(cuts.replace(exposed=exposed, held=held))
    assert (overlap > 0.9).all()
    assert reliable.nonzero()[:, 0].tolist() == [0, 1, 4, 7]
