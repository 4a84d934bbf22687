"""Which way G works, against brute force."""

import pytest
import torch
from torch.testing import assert_close

from pimper_torch.ground.geometry.subdivision import subdivide
from pimper_torch.ground.linalg.sparse import SparseCholesky
from pimper_torch.paper.refine import (
    assemble,
    seam_weight,
)

SPACING = 0.05


@pytest.fixture(scope="module")
def square():
    """Two flat facets with a seam on the diagonal, 20 spacings a side."""
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=torch.float64)
    facets = torch.tensor([[0, 1, 2], [0, 2, 3]])
    return subdivide(vertices, facets, torch.full((2,), SPACING).double())


def everywhere(subdivision):
    return torch.ones(len(subdivision.points), dtype=torch.bool)


def published(subdivision, blend, radius):
    fidelity = torch.full((2,), (radius * SPACING) ** -2, dtype=torch.float64)
    rows, cols, values, mass = assemble(subdivision, fidelity, everywhere(subdivision))
    factor = SparseCholesky(rows, cols, values, size=len(blend))
    return factor.solve(mass[:, None] * blend)


def test_the_centre_of_a_facet_is_kept_and_seams_are_smoothed_the_more_the_larger_g(square):
    """White noise keeps what G leaves of it: all at G = 0, least at the vertices."""
    generator = torch.Generator().manual_seed(92)
    kept = torch.zeros(len(square.points), dtype=torch.float64)
    flat = torch.zeros_like(square.points)
    for _ in range(60):
        noise = torch.randn(len(kept), generator=generator, dtype=torch.float64)
        blend = flat.clone()
        blend[:, 2] = noise
        kept += published(square, blend, 0.5)[:, 2] * noise
    kept = kept / 60  # the fraction of its own noise a vertex keeps
    inside = (square.barycentric > 0.02).all(dim=1)
    g = seam_weight(square.barycentric)
    centre = (square.barycentric - 1 / 3).abs().amax(dim=1) < 0.04
    assert centre.any()
    assert kept[centre].mean() > 0.7  # a vertex's neighbours lie where G is 0.1 already
    steps = [(0.0, 0.25), (0.25, 0.35), (0.35, 0.45), (0.45, 0.6)]
    fractions = [float(kept[inside & (g >= low) & (g < high)].mean()) for low, high in steps]
    assert fractions == sorted(fractions, reverse=True)
    assert fractions[0] > 1.7 * fractions[-1]
    edge = (square.barycentric.amin(dim=1) < 1e-9) & (g < 0.52)
    corner = square.barycentric.amax(dim=1) > 1 - 1e-9
    assert float(kept[corner].mean()) < float(kept[edge].mean()) < 0.45


def test_smoothing_at_a_seam_has_the_width_that_the_docstring_gives():
    """Where G is 1/2 throughout, a wave keeps 1 / (1 + (2 pi r / w)^2) of its height."""
    columns = torch.arange(160, dtype=torch.float64) * SPACING
    x, y = torch.meshgrid(columns, columns[:5], indexing="ij")
    points = torch.stack([x, y, 0 * x], dim=-1).reshape(-1, 3)
    index = torch.arange(len(points)).reshape(160, 5)
    low = torch.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:]], dim=-1).reshape(-1, 3)
    up = torch.stack([index[:-1, :-1], index[1:, 1:], index[:-1, 1:]], dim=-1).reshape(-1, 3)
    faces = torch.cat([low, up])
    vertices = torch.tensor([[0.0, 0, 0], [8, 0, 0], [0, 8, 0]], dtype=torch.float64)
    template = subdivide(vertices, torch.tensor([[0, 1, 2]]), torch.full((1,), 4.0).double())
    subdivision = template.replace(
        points=points,
        facet=torch.zeros(len(points), dtype=torch.long),
        barycentric=torch.tensor([0.5, 0.5, 0.0]).double().expand(len(points), 3),
        faces=faces,
        face_facet=torch.zeros(len(faces), dtype=torch.long),
    )
    radius, wave = 3.0, 32
    blend = torch.zeros_like(points)
    blend[:, 2] = torch.cos(2 * torch.pi * x / (wave * SPACING)).reshape(-1)
    found = published(subdivision, blend, radius)[:, 2].reshape(160, 5)[32:128]
    fraction = (found * blend[:, 2].reshape(160, 5)[32:128]).sum()
    fraction = fraction / blend[:, 2].reshape(160, 5)[32:128].square().sum()
    wanted = 1 / (1 + (2 * torch.pi * radius / wave) ** 2)
    assert_close(fraction, torch.tensor(wanted).double(), atol=0.01, rtol=0)  # finite elements
