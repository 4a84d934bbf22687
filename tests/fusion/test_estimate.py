import pytest
import torch
from torch.testing import assert_close
from twins import using

from pimper_torch.linalg.multigrid import Multigrid
from pimper_torch.linalg.prepared import SingularSystemError
from pimper_torch.runtime.errors import PimperWarning
from pimper_torch.stages.fusion.equations import Equations
from pimper_torch.stages.fusion.estimate import fuse_like, fuse_terms, noise_factor

COUNT = 900


def smooth() -> torch.Tensor:
    x = torch.linspace(0, 12, COUNT, dtype=torch.float64)
    return x.sin() + 0.3 * (3 * x).cos()


def steps(noise: torch.Tensor, deviation: float) -> Equations:
    """Return steps of a chain of heights, each measured three times, as in a triangle mesh."""
    first = torch.arange(COUNT - 1).repeat(3)
    return Equations(
        unknowns=torch.stack([first, first + 1], dim=1),
        coefficients=torch.tensor([-1.0, 1.0]).double().expand(len(first), 2),
        targets=smooth().diff().repeat(3) + noise,
        information=torch.full((len(first),), deviation**-2, dtype=torch.float64),
        correlated=torch.ones(len(first), dtype=torch.float64),
    )


def places(noise: torch.Tensor, deviation: float) -> Equations:
    return Equations(
        unknowns=torch.arange(COUNT)[:, None],
        coefficients=torch.ones(COUNT, 1, dtype=torch.float64),
        targets=smooth() + noise,
        information=torch.full((COUNT,), deviation**-2, dtype=torch.float64),
        correlated=torch.ones(COUNT, dtype=torch.float64),
    )


def fused(kinds, iterations: int = 6):
    return fuse_terms(
        kinds, torch.zeros(COUNT).double(), torch.full((COUNT,), 1e-9).double(), iterations
    )


def drawn(generator, deviation: float, count: int = COUNT) -> torch.Tensor:
    return deviation * torch.randn(count, generator=generator, dtype=torch.float64)


def test_noise_factors_correct_wrong_variances(generator):
    kinds = [
        steps(drawn(generator, 0.02, 3 * (COUNT - 1)), 0.005),  # states a quarter of its noise
        places(drawn(generator, 0.1), 0.18),  # states nearly twice its noise
    ]
    found = fused(kinds, iterations=12)
    assert abs(found.factors[0] / 16 - 1) < 0.25
    assert abs(found.factors[1] * 3.24 - 1) < 0.25


def test_outliers_lose_their_weight(generator):
    wrong = drawn(generator, 0.05)
    wrong[::10] = 4.0
    found = fused([steps(drawn(generator, 0.02, 3 * (COUNT - 1)), 0.02), places(wrong, 0.05)])
    clean = drawn(generator, 0.05)
    clean[::10] = 0
    there = fused([steps(drawn(generator, 0.02, 3 * (COUNT - 1)), 0.02), places(clean, 0.05)])
    off = (found.heights - smooth()).square().mean().sqrt()
    assert off < 2 * (there.heights - smooth()).square().mean().sqrt()
    assert abs(float((found.heights - smooth()).mean())) < 0.05  # the mean alone would be 0.4 off


def test_one_solve_is_plain_least_squares(generator):
    kinds = [
        steps(drawn(generator, 0.02, 3 * (COUNT - 1)), 0.02),
        places(drawn(generator, 0.1), 0.1),
    ]
    J = torch.zeros(4 * COUNT - 3, COUNT, dtype=torch.float64)
    row = 0
    for kind in kinds:
        scale = kind.information.sqrt()
        index = torch.arange(row, row + len(scale))
        for term in range(kind.unknowns.shape[1]):
            J[index, kind.unknowns[:, term]] += scale * kind.coefficients[:, term]
        row += len(scale)
    right = torch.cat([kind.information.sqrt() * kind.targets for kind in kinds])
    assert_close(fused(kinds, iterations=1).heights, torch.linalg.lstsq(J, right).solution)


def test_vertices_without_equations_keep_their_heights():
    kind = places(torch.zeros(COUNT).double(), 0.1)
    some = kind.take(torch.arange(10))
    start = torch.full((COUNT,), 5.0, dtype=torch.float64)
    found = fuse_terms([some], start, torch.full((COUNT,), 1e-9).double(), 1).heights
    assert_close(found[10:], start[10:])
    assert_close(found[:10], smooth()[:10], rtol=0, atol=1e-6)


def with_common_errors(kind, together: float):
    """Add a shared error with `together` times the variance of each equation."""
    total = 1 / kind.information + together / kind.information
    return kind.replace(information=1 / total, correlated=torch.full_like(total, 1 + together))


def test_a_solve_with_shared_errors_reuses_robust_weights(generator):
    # Overconfident slopes and underconfident places, some of which are outliers.
    noise = drawn(generator, 0.1)
    noise[::50] += 5
    kinds = [steps(drawn(generator, 0.005, 3 * (COUNT - 1)), 0.02), places(noise, 0.02)]
    alone = fused(kinds)
    assert alone.factors[0] < 1 < alone.factors[1]
    assert alone.weights[1][::50].max() < 0.1
    common = [with_common_errors(kinds[0], 8.0), kinds[1]]
    found = fuse_like(alone, common, torch.zeros(COUNT).double())

    rows = torch.zeros(len(kinds[0].targets), COUNT).double()
    rows.scatter_(1, kinds[0].unknowns, kinds[0].coefficients)
    rows = torch.cat([rows, torch.eye(COUNT).double()])
    weights = [
        weight * kind.information for weight, kind in zip(alone.weights, common, strict=True)
    ]
    weighted = torch.cat(weights)[:, None] * rows
    targets = torch.cat([kind.targets for kind in common])
    matrix = rows.T @ weighted + 1e-9 * torch.eye(COUNT)
    assert_close(found.heights, torch.linalg.solve(matrix, weighted.T @ targets))
    assert_close(torch.stack(found.factors), torch.ones(2).double())


@pytest.mark.parametrize("kernels", ["numba", "torch"])
def test_cholesky_solves_if_multigrid_does_not_converge(generator, monkeypatch, kernels):
    kinds = [steps(drawn(generator, 0.02, 3 * (COUNT - 1)), 0.02), places(0 * smooth(), 0.1)]
    expected = fused(kinds)
    stuck = []

    def refusing(*arguments):
        stuck.append(arguments)
        raise SingularSystemError("no convergence")

    monkeypatch.setattr("pimper_torch.linalg.systems._CHOLESKY_UNKNOWNS", 100)
    monkeypatch.setattr("pimper_torch.linalg.systems._COMPILED_CHOLESKY_UNKNOWNS", 100)
    monkeypatch.setattr(Multigrid, "solve", refusing)
    monkeypatch.setattr("pimper_torch.linalg.systems.solve_by_cycles", refusing)
    with using(kernels), pytest.warns(PimperWarning, match="solved by a Cholesky factor"):
        found = fused(kinds)
    assert stuck
    assert_close(found.heights, expected.heights)
    assert_close(torch.stack(found.factors), torch.stack(expected.factors))


@pytest.mark.parametrize("outliers", [0, 1000])
def test_the_noise_factor_is_robust_to_outliers(generator, outliers):
    square = 9.0 * drawn(generator, 1.0, 20000).square()
    square[:outliers] = 1e6
    assert abs(noise_factor(square) / 9 - 1) < (0.25 if outliers else 0.05)
