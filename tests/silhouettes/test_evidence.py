"""The maps that the network reads, and the network."""

import pytest
import torch
from safetensors.torch import save_file
from scenes import observing

from pimper_bench.evidence.evidence_maps import MAPS, evidence_maps
from pimper_bench.evidence.silhouette_network import SilhouetteNetwork, load_network, read
from pimper_bench.evidence.soft_masks import cut_of_view, second_reading, soft_masks
from pimper_torch.geometry.opencv import signed_distance
from pimper_torch.stages.silhouettes.cues import cues_of
from pimper_torch.stages.silhouettes.find import FindSilhouettes
from tests.silhouettes.conftest import SMALL, overlap

GROUPS = list(MAPS.values())


@pytest.fixture(scope="module")
def evidence(staged):
    return evidence_maps(cues_of(staged.scene, SMALL))


def of_group(maps, group):
    return maps[[index for index, name in enumerate(GROUPS) if name == group]]


def test_maps_are_finite_and_bounded(evidence, staged):
    maps = evidence.of(3)
    assert maps.shape == (len(MAPS), 180, 240)
    assert maps.isfinite().all()
    assert maps.abs().max() <= 3
    assert not of_group(maps, "hull").any()
    assert not of_group(maps, "background").any()
    near_object, near_others = of_group(maps, "points")
    assert near_object[staged.truth[3]].mean() > 2 * near_object[~staged.truth[3]].mean()
    assert near_others[~staged.truth[3]].mean() > 2 * near_others[staged.truth[3]].mean()


def test_cues_that_are_unknown_are_zero(staged):
    alone = evidence_maps(cues_of(observing(staged.scene, slice(0)), SMALL))
    maps = alone.of(0)
    for group in ("light", "texture", "background", "plane", "points", "hull"):
        assert not of_group(maps, group).any()
    assert of_group(maps, "brightness").any()
    assert of_group(maps, "centre").any()


def test_the_hull_is_a_map_of_the_second_reading(evidence, staged):
    margins = torch.where(staged.truth, 50.0, -2.0)
    inside, known = of_group(evidence.replace(margins_px=margins).of(1), "hull")
    assert (known == 1).all()
    assert (inside[staged.truth[1]] == 1).all()
    assert inside[~staged.truth[1]] == pytest.approx(-0.2)


def test_distances_on_the_plane_are_those_of_its_places(evidence, staged):
    apart, meets = of_group(evidence.of(5), "plane")
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
        points, others, inside, _ = maps[:, -4:].unbind(dim=1)
        return 3 * (points - others) - 1 + 4 * inside


def test_readings_and_colours_give_soft_masks(staged, evidence):
    first = read(evidence, Points())
    again = second_reading(evidence, first)
    assert again is not None
    assert again.margins_px is not None
    second = read(again, Points())
    assert overlap(second > 0, staged.truth).mean() > overlap(first > 0, staged.truth).mean()
    prior = soft_masks(staged.scene, Points())
    assert prior.names == staged.scene.views.names
    assert overlap(prior.inside > 0.5, staged.truth).min() > 0.9
    views = staged.scene.views.replace(priors=(prior,))
    found = FindSilhouettes(SMALL)(staged.scene.replace(views=views))
    assert overlap(found.masks, staged.truth).min() > 0.95


def test_colours_decide_only_where_odds_are_not_clear(staged, evidence):
    """The ball is red and the table grey."""
    border = signed_distance(staged.truth[2])
    unclear = torch.where(border > 8, 6.0, torch.where(border < -8, -6.0, -0.5))
    cut = cut_of_view(evidence.cues, 2, unclear)
    assert overlap(cut[None], staged.truth[2:3]) > 0.95
    shifted = staged.truth[2].roll(60, 1)
    clear = torch.where(shifted, 9.0, -9.0)
    bare = evidence.cues.replace(object_px=(torch.zeros(0, 2),) * 12)
    assert torch.equal(cut_of_view(bare, 2, clear), shifted)


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
