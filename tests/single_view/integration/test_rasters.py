"""Weighted rasters against dense matrices and closed forms."""

from typing import NamedTuple

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from pimper_torch.linalg import hierarchy
from pimper_torch.linalg.prepared import SingularSystemError
from pimper_torch.paper.integrate import differences, differences_transposed
from pimper_torch.single_view.integration.raster_system import RasterSystem


class Weighted(NamedTuple):
    right: Tensor
    down: Tensor
    anchor: Tensor

    @property
    def shape(self):
        return self.anchor.shape

    def dense(self):
        unit = torch.eye(self.anchor.numel(), dtype=torch.float64).reshape(-1, *self.shape)
        return applied(self, unit).flatten(1)


def equal(height, width, anchor=0.0):
    ones = torch.ones(height, width, dtype=torch.float64)
    return Weighted(ones[:, 1:], ones[1:], anchor * ones)


def masked(weighted, inside):
    right = weighted.right * (inside[:, 1:] & inside[:, :-1])
    down = weighted.down * (inside[1:] & inside[:-1])
    return Weighted(right, down, weighted.anchor * inside)


def ragged(height, width):
    """Return a disc with two holes, an island of 2 x 2 and a separate single pixel."""
    row, col = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    inside = (row - height / 2) ** 2 + (col - width / 2) ** 2 < (0.4 * min(height, width)) ** 2
    inside[height // 2 : height // 2 + 2, width // 2] = False
    inside[height // 3, width // 3 : width // 3 + 3] = False
    inside[:2, :2] = True
    inside[0, -1] = True
    return inside


def terraced(height, width, drop=1e-8):
    """Return plateaus with tiny weights between them, like heights cut at depth edges."""
    row, col = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    level = ((col / 5).sin() * (row / 7).cos() * 3).floor()
    weighted = equal(height, width)
    right = torch.where(level.diff(dim=1) != 0, drop, weighted.right)
    return Weighted(right, torch.where(level.diff(dim=0) != 0, drop, weighted.down), 0 * level)


@pytest.fixture(params=["cholesky", "multigrid"])
def method(request, monkeypatch):
    most = 10**9 if request.param == "cholesky" else 0
    monkeypatch.setattr("pimper_torch.single_view.integration.raster_system._CHOLESKY_PIXELS", most)
    return request.param


@pytest.fixture(params=["equal", "ragged", "terraced", "jumping", "strips", "empty"])
def weighted(request, generator):
    plain = equal(20, 23)  # larger than the dense coarsest level of a hierarchy
    part = ragged(20, 23)
    return {
        "equal": plain,
        "ragged": masked(plain, part),
        "terraced": masked(terraced(20, 23), part),
        "jumping": Weighted(
            *(10 ** (-8 * uniform(generator, w.shape)) for w in plain[:2]), plain[2]
        ),
        "strips": plain._replace(right=0 * plain.right),
        "empty": masked(plain, part & False),
    }[request.param]


def uniform(generator, shape):
    return torch.rand(shape, generator=generator, dtype=torch.float64)


def applied(weighted, heights):
    right, down = differences(heights)
    image = differences_transposed(weighted.right * right, weighted.down * down)
    return image + weighted.anchor * heights


def component_means(weighted, heights):
    """Replace every height by the mean of its connected component, by brute force."""
    reach = ((weighted.dense() != 0) | torch.eye(heights.numel(), dtype=torch.bool)).double()
    for _ in range(12):  # path lengths double
        reach = (reach @ reach).sign()
    return (reach @ heights.flatten() / reach.sum(dim=1)).reshape(heights.shape)


def test_heights_are_recovered_from_their_source_up_to_component_means(weighted, method, generator):
    heights = uniform(generator, weighted.shape)
    found = RasterSystem(*weighted).solve(applied(weighted, heights))
    expected = heights - component_means(weighted, heights)
    # A plateau coupled by 1e-8 amplifies the rounding of its source by 1e8.
    assert_close(found, expected, atol=3e-6, rtol=0)


def test_with_anchors_the_solution_equals_a_dense_solve(weighted, method, generator):
    anchor = 0.1 * (uniform(generator, weighted.shape) < 0.2).double()
    anchor[:2, :2] = 1e-6  # an island with a tiny anchor
    held = weighted._replace(anchor=anchor)
    matrix = held.dense()
    joined = (component_means(held, (anchor > 0).double()) > 0).flatten()
    source = uniform(generator, weighted.shape) - 0.5
    found = RasterSystem(*held).solve(source).flatten()
    dense = matrix[joined][:, joined]
    scale = dense.diagonal().rsqrt()
    dense = scale[:, None] * dense * scale
    expected = scale * torch.linalg.solve(dense, scale * source.flatten()[joined])
    apart = (found[joined] - expected).abs().max()
    assert apart <= 1e-6 * expected.abs().max()
    assert (found[matrix.diagonal() == 0] == 0).all()


@pytest.mark.parametrize("shape", [(24, 31), (1, 40), (40, 1), (1, 1)])
def test_weights_of_two_sizes_on_rectangles_and_lines(method, shape, generator):
    plain = equal(*shape, anchor=0.01)
    scaled = Weighted(2 * plain.right, 5 * plain.down, plain.anchor)
    source = uniform(generator, shape)
    expected = torch.linalg.solve(scaled.dense(), source.flatten()).reshape(shape)
    assert_close(RasterSystem(*scaled).solve(source), expected, rtol=1e-8, atol=1e-8)


def test_steps_without_weight_are_ignored():
    right, down = torch.ones(3, 3), torch.ones(2, 4)
    right[0], down[0] = 0, 0
    solver = RasterSystem(right, down)
    steps = torch.where(right > 0, 1.0, torch.nan), torch.where(down > 0, 0.5, torch.inf)
    expected = torch.tensor([[-1.75, -0.75, 0.25, 1.25], [-1.25, -0.25, 0.75, 1.75]])
    assert_close(solver.fit_steps(*steps)[1:], expected)
    assert (solver.fit_steps(*steps)[0] == 0).all()


@pytest.mark.parametrize("held", [False, True])
def test_gradients_reach_weights_anchors_and_source(method, held, generator, monkeypatch):
    monkeypatch.setattr(hierarchy, "_DENSE", 3)  # so that there are cycles to differentiate
    tied = torch.tensor([[True, True], [True, False], [True, True]]), torch.ones(2, 3).bool()
    tied[1][0, 2] = tied[1][1, 2] = False  # one pixel of the centre row is outside
    anchor = torch.full((3, 3), 0.3 if held else 0.0, dtype=torch.float64)
    anchor[1, 2] = 0
    weights = [0.5 + uniform(generator, int(t.sum())) for t in tied]
    inputs = [*weights, uniform(generator, (2, 3, 3)), *([anchor[anchor > 0]] if held else [])]

    def heights(right, down, source, *known):
        filled = [
            torch.zeros(where.shape, dtype=torch.float64).masked_scatter(where, part)
            for part, where in zip((right, down), tied, strict=True)
        ]
        held_at = torch.zeros_like(anchor).masked_scatter(anchor > 0, *known) if known else None
        return RasterSystem(*filled, held_at, tolerance=1e-14).solve(source)

    leaves = [part.requires_grad_() for part in inputs]
    assert torch.autograd.gradcheck(heights, leaves)
    if method == "cholesky":  # the backward pass is the same
        leaves[2] = leaves[2].detach()[:1].requires_grad_()
        assert torch.autograd.gradgradcheck(heights, leaves, atol=1e-4)


def test_float32_rasters_are_solved_in_float64(method, generator):
    weighted = terraced(30, 30, drop=1e-3)
    single = Weighted(*(part.float() for part in weighted))
    source = applied(weighted, uniform(generator, (30, 30))).float()
    found = RasterSystem(*single).solve(source)
    assert found.dtype == torch.float32
    expected = RasterSystem(*(part.double() for part in single)).solve(source.double())
    assert_close(found.double(), expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("where", [0, 2])
def test_a_source_or_weight_that_is_not_finite_is_rejected(method, where):
    right, down, source = given = torch.ones(30, 29), torch.ones(29, 30), torch.ones(30, 30)
    given[where][5, 6] = torch.nan
    with pytest.raises(SingularSystemError):
        RasterSystem(right, down).solve(source)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_cuda_agrees_with_the_cpu(weighted, generator):
    source = applied(weighted, uniform(generator, weighted.shape))
    found = RasterSystem(*(part.cuda() for part in weighted)).solve(source.cuda())
    assert_close(found.cpu(), RasterSystem(*weighted).solve(source), atol=1e-5, rtol=0)
