"""The training of the silhouettes' network: stored maps, variation, and continuation."""

import numpy as np
import pytest
import torch
import train_silhouettes as study

from pimper_torch.stages.silhouettes.evidence import MAPS
from pimper_torch.stages.silhouettes.network import load_network

GROUPS = list(MAPS.values())


@pytest.fixture
def stored(tmp_path, generator):
    """Store two captures of bright discs, whose brightness alone shows them."""
    for seed in range(2):
        column, row = torch.meshgrid(torch.arange(48), torch.arange(36), indexing="xy")
        centres = 12 + 12 * torch.rand(3, 2, generator=generator)
        apart = (column - centres[:, 0, None, None]) ** 2 + (row - centres[:, 1, None, None]) ** 2
        truth = apart < 64
        maps = 0.1 * torch.randn(3, len(MAPS), 36, 48, generator=generator)
        maps[:, 0] += torch.where(truth, 1.0, -1.0)
        study.write(tmp_path / f"{seed}.npy", iter(maps), truth)
    return tmp_path


def test_stored_maps_are_those_written(tmp_path, generator):
    maps = 6 * torch.rand(2, len(MAPS), 8, 12, generator=generator) - 3
    truth = torch.rand(2, 8, 12, generator=generator) > 0.5
    study.write(tmp_path / "0.npy", iter(maps), truth)
    (read,) = study.existing(tmp_path, range(3))
    assert np.array_equal(read[:, -1] > 0, truth.numpy())
    back = (torch.from_numpy(np.array(read[:, :-1])).float() - 127.5) / study.LEVELS
    assert (back - maps).abs().max() < 0.6 / study.LEVELS
    assert [path.name for path in tmp_path.iterdir()] == ["0.npy"]


def test_batches_are_crops_or_whole_views_with_groups_left_out(stored):
    captures = study.existing(stored, range(2))
    batches = study.Batches(captures, torch.Generator().manual_seed(0))
    maps, truth = batches.draw(small=False)
    assert maps.shape == (4, len(MAPS), 24, 32)
    assert truth.shape == (4, 24, 32)
    left_out = set()
    for _ in range(40):
        maps, truth = batches.draw(small=True)
        assert maps.shape == (6, len(MAPS), 18, 24)
        for sample in maps:
            empty = {g for g, values in zip(GROUPS, sample, strict=True) if not values.any()}
            full = {g for g, values in zip(GROUPS, sample, strict=True) if values.any()}
            assert not empty & full  # a group is known or unknown as a whole
            left_out |= empty
    assert left_out == set(GROUPS)


def test_training_lowers_the_loss_and_continues_where_it_was(stored, tmp_path):
    captures = study.existing(stored, range(2))
    run = study.Run(tmp_path, minutes=0.05)
    maps, truth = study.Batches(captures, torch.Generator().manual_seed(1)).draw(small=False)
    before = float(study.loss_of(run.network, maps, truth).detach())
    run.train(lambda: captures)
    assert float(study.loss_of(run.network, maps, truth).detach()) < 0.9 * before
    again = study.Run(tmp_path, minutes=0.05)
    assert again.steps == run.steps > 3
    assert 1 <= again.done < 1.5
    for one, other in zip(run.network.parameters(), again.network.parameters(), strict=True):
        assert torch.equal(one, other)
    overlaps, calibration = study.measured(run.network.eval(), captures)
    assert len(overlaps) == 2
    assert all(read > cut for cut, read in overlaps)  # the stored cuts are noise
    assert sum(count for _, _, count in calibration) == 2 * 3 * 36 * 48


def test_odds_are_calibrated_on_captures(stored):
    captures = study.existing(stored, range(2))
    torch.manual_seed(0)
    network = study.SilhouetteNetwork().eval()
    network.last.weight.data *= 40  # far too certain

    def gap():
        _, rows = study.measured(network, captures)
        return sum(abs(read - true) * count for read, true, count in rows) / (2 * 3 * 36 * 48)

    before = gap()
    study.calibrate(network, captures)
    after, found = gap(), network.calibration.clone()
    assert after < 0.5 * before
    study.calibrate(network, captures)
    assert torch.allclose(network.calibration, found)


def test_weights_are_written_without_captures_to_test_on(tmp_path):
    study.Run(tmp_path, minutes=1).finish([])
    network = load_network(tmp_path / "silhouettes.safetensors")
    assert network.calibration.tolist() == [1, 0]
