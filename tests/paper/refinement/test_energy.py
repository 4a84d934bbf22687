import pytest
import torch
from torch.testing import assert_close

from pimper_torch.ground.geometry.subdivision import subdivide
from pimper_torch.ground.linalg.sparse import SparseCholesky
from pimper_torch.paper.refine import assemble, seam_weight


def minimiser(subdivision, blend, supported, radius, num_facets, spacing=0.1):
    fidelity = torch.full((num_facets,), (radius * spacing) ** -2, dtype=torch.float64)
    rows, cols, values, mass = assemble(subdivision, fidelity, supported)
    factor = SparseCholesky(rows, cols, values, size=len(blend))
    return factor.solve(mass[:, None] * blend)


@pytest.fixture
def folded():
    """Four facets round a centre, lifted like a tent, edges of unlike length."""
    vertices = torch.tensor(
        [[0.0, 0, 0.4], [1.1, 0, 0], [0.1, 0.9, 0.1], [-0.7, 0.1, 0], [0, -1.3, 0]],
        dtype=torch.float64,
    )
    facets = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]])
    return vertices, facets, subdivide(vertices, facets, torch.full((4,), 0.1).double())


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ([1 / 3, 1 / 3, 1 / 3], 0.0),
        ([0.5, 0.5, 0.0], 0.5),
        ([0.0, 0.5, 0.5], 0.5),
        ([1.0, 0.0, 0.0], 0.5**0.5),
        ([0.0, 0.0, 1.0], 0.5**0.5),
        ([0.5, 0.25, 0.25], 0.5 * 0.5**0.5),
    ],
)
def test_the_seam_weight_has_the_published_values(place, value):
    found = seam_weight(torch.tensor(place, dtype=torch.float64))
    assert_close(found, torch.tensor(value, dtype=torch.float64), atol=1e-7, rtol=0)


def test_the_solution_minimises_the_published_energy(folded):
    _, _, subdivision = folded
    generator = torch.Generator().manual_seed(81)
    blend = subdivision.points + 0.05 * torch.randn(
        subdivision.points.shape, generator=generator, dtype=torch.float64
    )
    supported = torch.rand(len(blend), generator=generator) < 0.8
    radius, spacing = 2.0, 0.1
    found = minimiser(subdivision, blend, supported, radius, 4)
    found.requires_grad_()

    # The energy face by face, written out: gradients of linear functions from edge vectors.
    weights = seam_weight(subdivision.barycentric)
    corners, values = subdivision.points[subdivision.faces], found[subdivision.faces]
    frame = (corners[:, 1:] - corners[:, :1]).mT
    slope = (values[:, 1:] - values[:, :1]).mT @ torch.linalg.pinv(frame)
    area = torch.linalg.cross(*frame.unbind(dim=-1)).norm(dim=-1) / 2
    apart = (1 - weights) * supported * (blend - found).square().sum(-1)
    lumped = apart[subdivision.faces].mean(dim=1) / (radius * spacing) ** 2
    smooth = weights[subdivision.faces].mean(dim=1) * slope.square().sum(dim=(1, 2))
    (gradient,) = torch.autograd.grad((area * (lumped + smooth)).sum(), found)
    assert gradient.abs().max() < 1e-7 * (radius * spacing) ** -2 * float(area.max())


def test_vertices_without_support_continue_the_plane_round_them(folded):
    _, _, subdivision = folded
    flat = subdivision.points * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    plane = flat + torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64)
    hole = (flat[:, :2] - torch.tensor([0.3, 0.2])).norm(dim=1) < 0.25
    assert hole.sum() > 5
    spoiled = torch.where(hole[:, None], subdivision.points, plane)
    found = minimiser(subdivision, spoiled, ~hole, 2.0, 4)
    assert (found[:, 2] - 2).abs().max() < 1e-6
