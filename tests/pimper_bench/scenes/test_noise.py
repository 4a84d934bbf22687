import torch
from torch.testing import assert_close

from pimper_bench.scenes.textures import random_speckle, random_waves


def test_waves_have_the_stated_deviation_and_wavelength(generator):
    waves = random_waves(generator, wavelength=0.5, root_mean_square=0.3, num_waves=40)
    points = 20 * torch.rand(4000, 3, generator=generator, dtype=torch.float64)
    assert abs(waves(points).std() - 0.3) < 0.03  # 4000 draws of 40 waves vary by a few %
    points.requires_grad_()
    (gradient,) = torch.autograd.grad(waves(points).sum(), points)
    steepest = gradient.norm(dim=1).max()
    assert 2 * torch.pi / 0.5 * 0.3 < steepest < 2 * torch.pi / 0.5 * 0.3 * 6


def test_speckle_depends_only_on_the_position_and_is_bounded(generator):
    speckle = random_speckle(generator, darkest=0.2, brightest=0.7)
    points = 6 * torch.rand(5000, 3, generator=generator) - 3
    albedo = speckle(points)
    assert albedo.shape == (5000, 3)
    assert albedo.min() >= 0.2 - 1e-6  # float32
    assert albedo.max() <= 0.7 + 1e-6
    assert albedo.std() > 0.1
    assert_close(speckle(points[1234:1240]), albedo[1234:1240])


def test_speckle_is_continuous_across_the_edge_of_its_period(generator):
    speckle = random_speckle(generator, cells=(0.1,))
    for edge in (0.0, 3.2, -3.2):  # 32 cells of 0.1
        near = torch.tensor([[edge - 1e-5, 0.3, 0.3], [edge + 1e-5, 0.3, 0.3]])
        low, high = speckle(near.double())
        assert_close(low, high, atol=2e-3, rtol=0)


def test_without_contrast_albedo_is_uniform(generator):
    speckle = random_speckle(generator, contrast=0.0, darkest=0.2, brightest=0.8)
    albedo = speckle(torch.rand(50, 3, generator=generator))
    assert_close(albedo, torch.full((50, 3), 0.5))
