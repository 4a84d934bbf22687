"""The maps that the network reads, the network, and cuts by its odds."""

import pytest
import torch
from safetensors.torch import save_file
from scenes import observing

from pimper_torch.stages.silhouettes.cues import cues_of
from pimper_torch.stages.silhouettes.cuts import cut_in_iterations
from pimper_torch.stages.silhouettes.evidence import MAPS, Evidence
from pimper_torch.stages.silhouettes.find import FindSilhouettes
from pimper_torch.stages.silhouettes.network import SilhouetteNetwork, load_network
from pimper_torch.stages.silhouettes.read_again import expected_overlap, overruled, read_again
from tests.silhouettes import shapes
from tests.silhouettes.conftest import SMALL, overlap

GROUPS = list(MAPS.values())


@pytest.fixture(scope="module")
def evidence(staged):
    return Evidence.of(cues_of(staged.scene, SMALL), None)


def of_group(maps, group):
    return maps[[index for index, name in enumerate(GROUPS) if name == group]]


def test_maps_are_finite_and_bounded(evidence, staged):
    maps = evidence.maps(3)
    assert maps.shape == (len(MAPS), 180, 240)
    assert maps.isfinite().all()
    assert maps.abs().max() <= 3
    assert not of_group(maps, "cuts").any()
    near_object, near_others = of_group(maps, "points")
    assert near_object[staged.truth[3]].mean() > 2 * near_object[~staged.truth[3]].mean()
    assert near_others[~staged.truth[3]].mean() > 2 * near_others[staged.truth[3]].mean()


def test_cues_that_are_unknown_are_zero(staged):
    alone = Evidence.of(cues_of(observing(staged.scene, slice(0)), SMALL), None)
    maps = alone.maps(0)
    for group in ("light", "texture", "plane", "points", "cuts"):
        assert not of_group(maps, group).any()
    assert of_group(maps, "brightness").any()
    assert of_group(maps, "centre").any()


def test_cuts_and_their_hull_are_maps(evidence, staged):
    margins = torch.where(staged.truth, 50.0, -2.0)
    cuts = shapes.cuts_of(staged.truth, margins)
    hull, known, cut = of_group(evidence.replace(cuts=cuts).maps(1), "cuts")
    assert (known == 1).all()
    assert (hull[staged.truth[1]] == 1).all()
    assert hull[~staged.truth[1]] == pytest.approx(-0.2)
    assert torch.equal(cut > 0, staged.truth[1])
    assert cut.min() == -1


def test_distances_on_the_plane_are_those_of_its_places(evidence, staged):
    apart, meets = of_group(evidence.maps(5), "plane")
    assert (meets == 1).all()
    row, column = divmod(int(apart.argmin()), 240)
    # The foot of the fixation point, (0, 0, 0), is below the ball's centre.
    near = staged.truth[5].nonzero().float().mean(dim=0)
    assert abs(column - near[1]) < 3
    assert row > near[0]
    assert apart[row, column] < 0.02


class Points(torch.nn.Module):
    """Odds from the points nearby and, if it is known, the hull."""

    def forward(self, maps):
        points, others, hull, _, _ = maps[:, -5:].unbind(dim=1)
        return 9 * (points - others) - 3 + 12 * hull


class Nothing(torch.nn.Module):
    """Odds of photographs without an object."""

    def forward(self, maps):
        return torch.full_like(maps[:, 0], -9.0)


def test_cuts_that_lost_a_part_are_mended(staged, evidence):
    """The lower half of the ball is missing from a quarter of the cuts."""
    cues = evidence.cues
    cuts = cut_in_iterations(cues)
    damaged = cuts.masks.clone()
    damaged[::4, 100:] = False
    again = read_again(cues, cuts.replace(masks=damaged), Points())
    assert overlap(damaged, staged.truth).min() < 0.8
    assert overlap(again.masks, staged.truth).min() > 0.93
    assert overlap(again.margins_px > 0, staged.truth).min() > 0.9


class Holed(Points):
    """Points, but sure of a hole."""

    def forward(self, maps):
        odds = super().forward(maps)
        odds[:, 80:95, 110:130] = -9
        return odds


def test_occluded_pixels_stay_in_the_cut(staged, evidence):
    cuts = cut_in_iterations(evidence.cues)
    hidden = torch.zeros_like(cuts.masks)
    hidden[0, 80:95, 110:130] = True
    assert (staged.truth[:2, 80:95, 110:130]).all()
    again = read_again(evidence.cues, cuts.replace(hidden=hidden), Holed())
    assert again.masks[0, 80:95, 110:130].all()
    assert not again.masks[1, 83:92, 113:127].any()
    assert torch.equal(again.hidden, hidden)


def test_cuts_stay_if_the_network_sees_no_object(evidence):
    cuts = cut_in_iterations(evidence.cues)
    assert read_again(evidence.cues, cuts, Nothing()) is cuts


@pytest.mark.parametrize("network", [None, Points()])
def test_the_ball_is_found_with_each_network(staged, network):
    found = FindSilhouettes(SMALL, network)(staged.scene)
    assert overlap(found.masks, staged.truth).min() > 0.95


def test_sure_odds_change_wide_regions_and_no_outline(staged):
    cut = staged.truth[2]
    odds = torch.where(cut, 9.0, -9.0)
    assert torch.equal(overruled(cut, odds.roll(1, 1)), cut)
    assert torch.equal(overruled(cut, torch.full_like(odds, -1.0)), cut)
    assert not overruled(cut, torch.full_like(odds, -9.0)).any()
    lower = cut.clone()
    lower[100:] = False
    assert overlap(overruled(lower, odds)[None], cut[None]) > 0.97


def test_the_expected_overlap_is_that_of_probable_truths():
    mask = torch.zeros(40, 50, dtype=torch.bool)
    mask[:10] = True
    sure = torch.where(mask, 40.0, -40.0)
    assert expected_overlap(mask, sure) == pytest.approx(1)
    assert expected_overlap(mask, -sure) == pytest.approx(0)
    even = torch.where(mask, 0.0, -40.0)
    assert expected_overlap(mask, even) == pytest.approx(0.5)
    assert expected_overlap(mask, torch.zeros(40, 50)) == pytest.approx(0.125 / (0.25 + 0.375))


class Unsure(torch.nn.Module):
    """No opinion."""

    def forward(self, maps):
        return torch.zeros_like(maps[:, 0])


def test_uncertain_silhouettes_are_used_with_what_is_expected_of_them(staged):
    found = FindSilhouettes(SMALL, Unsure())(staged.scene)
    assert found.source == "found"
    assert found.figures()["expected_overlap"] == pytest.approx(found.expected_overlap.mean())
    assert found.expected_overlap.max() < 0.5


def test_a_network_reads_any_size_and_is_differentiable():
    torch.manual_seed(0)
    network = SilhouetteNetwork(widths=(8, 16))
    maps = torch.randn(1, len(MAPS), 21, 34, requires_grad=True)
    odds = network(maps)
    assert odds.shape == (1, 21, 34)
    odds.sum().backward()
    assert maps.grad is not None
    assert maps.grad.isfinite().all()
    assert all(value.grad.isfinite().all() for value in network.parameters())


def test_stored_weights_are_those_of_the_network(tmp_path):
    torch.manual_seed(1)
    network = SilhouetteNetwork()
    save_file({name: value.half() for name, value in network.state_dict().items()}, tmp_path / "w")
    again = load_network(tmp_path / "w")
    maps = torch.randn(1, len(MAPS), 32, 48)
    assert (again(maps) - network.eval()(maps)).abs().max() < 0.05
    assert not any(value.requires_grad for value in again.parameters())
