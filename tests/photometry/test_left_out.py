import torch

from pimper_torch.lighting.light_models import left_out, predicts_better


def test_a_fifth_of_seen_samples_is_held_out_per_sample_and_view(generator):
    found = left_out(torch.ones(100, 10, dtype=torch.bool))
    assert (found.sum(dim=0) == 20).all()
    assert (found.sum(dim=1) == 2).all()
    seen = torch.rand(100, 10, generator=generator) > 0.5
    assert (left_out(seen) == found & seen).all()


def test_a_gain_must_be_significant_and_large_enough(generator):
    simpler = 1 + 0.1 * torch.rand(12, generator=generator)
    assert predicts_better(0.9 * simpler, simpler)
    assert not predicts_better(0.97 * simpler, simpler)
    assert not predicts_better(simpler, 0.9 * simpler)
    uneven = torch.where(torch.arange(12) < 6, 0.5, 1.7)  # 4 % better, uncertain by 18 %
    assert not predicts_better(uneven * simpler, simpler)


def test_views_without_held_out_samples_are_ignored():
    simpler = torch.tensor([1.0, 1.01, torch.nan, 1.0])
    assert predicts_better(0.5 * torch.tensor([1.0, 1.0, 1.0, torch.nan]), simpler)
    assert not predicts_better(torch.full((4,), torch.nan), simpler)
    assert not predicts_better(torch.tensor([0.5, torch.nan]), torch.ones(2))
