import pytest
import torch
from torch.testing import assert_close
from twins import using

from pimper_torch.linalg.least_squares import compressed_equations, normal_equations
from pimper_torch.stages.fusion.equations import Equations
from pimper_torch.stages.fusion.estimate import _evaluated


@pytest.mark.parametrize("real", [torch.float32, torch.float64])
def test_compressed_rows_are_those_of_the_entries(real):
    generator = torch.Generator().manual_seed(4)
    size = 40
    damping = torch.rand(size, generator=generator, dtype=torch.float64) + 0.1
    start = torch.randn(size, generator=generator, dtype=real)
    kinds, dense, side = [], torch.diag(damping), damping * start
    for terms, count in ((2, 90), (1, 25), (3, 10), (1, 0)):
        unknowns = torch.randint(0, size, (count, terms), generator=generator)
        coefficients = torch.randn(count, terms, generator=generator, dtype=real)
        targets = torch.randn(count, generator=generator, dtype=real)
        weights = torch.rand(count, generator=generator, dtype=torch.float64)
        kinds.append((unknowns, coefficients, targets, weights))
        wide = unknowns, coefficients.double(), targets.double(), weights
        rows, cols, values, side_part = normal_equations(*wide, size)
        dense = dense.index_put((rows, cols), values, accumulate=True)
        side = side + side_part
    matrix, found = compressed_equations(kinds, damping, start)
    assert_close(torch.from_numpy(matrix.toarray()), dense)
    assert_close(found, side)
    assert matrix.has_sorted_indices
    assert matrix.has_canonical_format  # each entry once


@pytest.mark.parametrize("real", [torch.float32, torch.float64])
def test_evaluation_of_evidence_agrees_with_torch(real):
    generator = torch.Generator().manual_seed(5)

    def draw(*shape, dtype=real):
        return torch.rand(*shape, generator=generator, dtype=dtype) + 0.1

    kind = Equations(
        unknowns=torch.randint(0, 30, (200, 2), generator=generator),
        coefficients=draw(200, 2) - 0.6,
        targets=draw(200),
        information=draw(200),
        correlated=draw(200),
    )
    weight = draw(200, dtype=torch.float64)
    heights, probe, answer = (draw(30, dtype=torch.float64) - 0.6 for _ in range(3))
    square, used = _evaluated(kind, weight, heights, probe, answer)
    with using("torch"):
        expected, degrees = _evaluated(kind, weight, heights, probe, answer)
    assert_close(square, expected.double(), rtol=1e-5, atol=1e-6)
    assert_close(used, degrees.double(), rtol=1e-5, atol=1e-6)
