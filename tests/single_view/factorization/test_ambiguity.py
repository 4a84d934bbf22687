import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_torch.lighting.light_field import harmonics
from pimper_torch.single_view.factorization.ambiguity import (
    Ambiguity,
    align_factorizations,
    lorentz,
)


def some(generator, batch=3):
    generators = 0.5 * torch.randn(batch, 6, generator=generator, dtype=torch.float64)
    return Ambiguity(matrix=1.7 * lorentz(generators))


def cone_points(generator, batch=3, samples=40):
    n = normalize(torch.randn(batch, samples, 3, generator=generator, dtype=torch.float64), dim=-1)
    rho = 0.2 + torch.rand(batch, samples, 1, generator=generator, dtype=torch.float64)
    return (rho * harmonics(n)).mT


def test_the_inverse_is_that_of_the_negated_generator(generator):
    A, eye = some(generator), torch.eye(4, dtype=torch.float64).expand(3, 4, 4)
    assert_close(A.inverse().matrix @ A.matrix, eye)
    g = torch.randn(3, 6, generator=generator, dtype=torch.float64)
    assert_close(lorentz(g) @ lorentz(-g), eye)


def test_the_ambiguity_keeps_the_data_and_the_cone(generator):
    A, N = some(generator), cone_points(generator)
    L = torch.randn(3, 7, 4, generator=generator, dtype=torch.float64)
    moved = A.on_shading(N)
    assert_close(A.on_lights(L) @ moved, L @ N)
    assert_close(moved[:, 0], moved[:, 1:].norm(dim=1))
    assert (moved - N).abs().max() > 0.1


@pytest.mark.parametrize("mirrored", [1.0, -1.0])  # convex to concave
def test_alignment_recovers_the_applied_transformation(generator, mirrored):
    N, weight = cone_points(generator), torch.ones(3, 40, dtype=torch.float64)
    A = some(generator).matrix * torch.tensor([1.0, 1, 1, mirrored], dtype=torch.float64)
    assert_close(align_factorizations(N, A @ N, weight).matrix, A)


def test_alignment_under_noise_is_a_minimum_within_the_group(generator):
    N, A = cone_points(generator), some(generator)
    target = A.on_shading(N)
    target = target + 0.05 * torch.randn(target.shape, generator=generator, dtype=torch.float64)
    weight = torch.rand(3, 40, generator=generator, dtype=torch.float64)
    found = align_factorizations(N, target, weight)

    def cost(matrix):
        return (weight[:, None] * (target - matrix @ N) ** 2).sum(dim=(1, 2))

    least = cost(found.matrix)
    for _ in range(50):
        nudge = lorentz(1e-3 * torch.randn(3, 6, generator=generator, dtype=torch.float64))
        assert (cost(nudge @ found.matrix) >= least).all()
        assert (cost(1.0003 * found.matrix) >= least).all()
