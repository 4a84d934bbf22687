import pytest
import torch

from pimper_torch.records import Convergence
from pimper_torch.stages.photometry.bilinear import Factors, equations_of_samples, update_shading
from pimper_torch.stages.photometry.sample_estimates import fit_albedo, refine_on_manifold


def solved_under(problem, lights):
    """Return the least-squares factors of every sample under given lights."""
    equations = equations_of_samples(problem, lights, problem.weight)
    patches = torch.zeros(len(lights))
    return Factors(
        lights=lights,
        shading=update_shading(problem, *equations, problem.shading, steps=4),
        weight=problem.weight,
        convergence=Convergence(
            iterations=patches.long(), residual=patches.double(), cause=patches.long()
        ),
    )


def test_information_is_the_inverse_variance_of_normals_under_noise(problem, generator):
    # Oracle: the mean square angle over many draws of the noise.
    given, lights, shading = problem(patches=1, views=14, samples=40, missing=0.3)
    draws, deviation = 1000, 0.01

    def repeated(some):
        return some.expand(draws, -1, -1).contiguous()

    noise = torch.randn(draws, 14, 40, generator=generator, dtype=torch.float64)
    many = given.replace(
        radiance=given.radiance + deviation * noise,
        weight=repeated(given.weight),
        lights=repeated(lights),
        prior_mean=repeated(lights),
        shading=repeated(shading),
        regularization=given.regularization.expand(draws, -1),
    )
    _, normals, information = refine_on_manifold(many, solved_under(many, many.lights))
    variance = 1 / information
    _, true = given.manifold.split(shading.mT)
    square = (normals - true).square().sum(dim=-1)  # the angle's, to second order
    ratio = variance.mean(dim=0) / square.mean(dim=0)
    assert ratio.mean() == pytest.approx(1, abs=0.02)
    # Mean squares of a thousand draws are off by 3 to 4 percent; there are 40.
    assert ratio.min() > 0.85
    assert ratio.max() < 1.15


def test_albedo_per_channel_is_that_of_least_squares(problem, generator):
    given, lights, _ = problem(patches=2, views=6, samples=5, missing=0.2)
    basis = torch.randn(2, 4, 5, generator=generator, dtype=torch.float64)
    radiance = torch.rand(2, 6, 3, 5, generator=generator, dtype=torch.float64)
    found = fit_albedo(radiance, given.weight, lights, basis)
    column = given.weight.sqrt() * (lights @ basis)
    side = given.weight.sqrt()[:, :, None] * radiance
    expected = torch.linalg.lstsq(
        column.permute(0, 2, 1)[..., None], side.permute(0, 3, 1, 2)
    ).solution[:, :, 0]
    torch.testing.assert_close(found, expected.mT.clamp_min(0))
    assert 0 < (found == 0).double().mean() < 1
    assert (fit_albedo(radiance, 0 * given.weight, lights, basis) == 0).all()
