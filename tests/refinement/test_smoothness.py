"""Which way G works, quadratic and robust smoothness, each against brute force."""

import pytest
import torch
from torch.testing import assert_close

from pimper_torch.errors import ConfigError
from pimper_torch.geometry.lattice import subdivide
from pimper_torch.linalg.sparse import SparseCholesky
from pimper_torch.records import StopCause
from pimper_torch.refinement.energy import (
    assemble,
    face_slopes,
    facet_trends,
    plane_pull,
    seam_weight,
    trend_deviation,
)
from pimper_torch.refinement.refine import Refine, RefineConfig
from pimper_torch.refinement.smoothness import charbonnier_weight, reweighted

SPACING = 0.05


@pytest.fixture(scope="module")
def square():
    """Two flat facets with a seam on the diagonal, 20 spacings a side."""
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=torch.float64)
    facets = torch.tensor([[0, 1, 2], [0, 2, 3]])
    return subdivide(vertices, facets, torch.full((2,), SPACING).double())


def everywhere(lattice):
    return torch.ones(len(lattice.points), dtype=torch.bool)


def published(lattice, union, radius):
    fidelity = torch.full((2,), (radius * SPACING) ** -2, dtype=torch.float64)
    parts = assemble(lattice, fidelity, everywhere(lattice))
    factor = SparseCholesky(parts.rows, parts.cols, parts.values, size=len(union))
    return factor.solve(parts.mass[:, None] * union)


def published_energy(lattice, union, places, radius):
    """The functional as printed, face by face, without a line of the package's assembly."""
    a, b, c = lattice.barycentric.unbind(dim=1)
    weights = ((a - b).abs() + (a - c).abs() + (c - b).abs()).sqrt() / 2
    corners, values = lattice.points[lattice.faces], places[lattice.faces]
    frame = (corners[:, 1:] - corners[:, :1]).mT
    slope = (values[:, 1:] - values[:, :1]).mT @ torch.linalg.pinv(frame)
    area = torch.linalg.cross(*frame.unbind(dim=-1)).norm(dim=-1) / 2
    apart = (1 - weights) * (union - places).square().sum(dim=-1) / (radius * SPACING) ** 2
    smooth = weights[lattice.faces].mean(dim=1) * slope.square().sum(dim=(1, 2))
    return (area * (apart[lattice.faces].mean(dim=1) + smooth)).sum()


def test_descent_on_the_printed_functional_arrives_at_the_solve(square):
    generator = torch.Generator().manual_seed(91)
    noise = torch.randn(square.points.shape, generator=generator, dtype=torch.float64)
    union = square.points + 0.05 * noise
    places = union.clone().requires_grad_()
    optimiser = torch.optim.LBFGS(
        [places],
        max_iter=500,
        history_size=50,
        tolerance_grad=1e-10,
        tolerance_change=1e-14,
        line_search_fn="strong_wolfe",
    )

    def closure():
        optimiser.zero_grad()
        energy = published_energy(square, union, places, 2.0)
        energy.backward()
        return energy

    optimiser.step(closure)
    assert (places.detach() - union).abs().max() > 0.02  # it moved
    assert_close(places.detach(), published(square, union, 2.0), atol=1e-5, rtol=0)


def test_the_middle_of_a_facet_is_kept_and_seams_are_smoothed_the_more_the_larger_g(square):
    """White noise keeps what G leaves of it: all at G = 0, least at the vertices."""
    generator = torch.Generator().manual_seed(92)
    kept = torch.zeros(len(square.points), dtype=torch.float64)
    flat = torch.zeros_like(square.points)
    for _ in range(60):
        noise = torch.randn(len(kept), generator=generator, dtype=torch.float64)
        union = flat.clone()
        union[:, 2] = noise
        kept += published(square, union, 0.5)[:, 2] * noise
    kept = kept / 60  # the share of its own noise a vertex keeps
    inside = (square.barycentric > 0.02).all(dim=1)
    g = seam_weight(square.barycentric)
    middle = (square.barycentric - 1 / 3).abs().amax(dim=1) < 0.04
    assert middle.any()
    assert kept[middle].mean() > 0.7  # a vertex's neighbours lie where G is 0.1 already
    steps = [(0.0, 0.25), (0.25, 0.35), (0.35, 0.45), (0.45, 0.6)]
    shares = [float(kept[inside & (g >= low) & (g < high)].mean()) for low, high in steps]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > 1.7 * shares[-1]
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
    lattice = template.replace(
        points=points,
        facet=torch.zeros(len(points), dtype=torch.long),
        barycentric=torch.tensor([0.5, 0.5, 0.0]).double().expand(len(points), 3),
        faces=faces,
        face_facet=torch.zeros(len(faces), dtype=torch.long),
    )
    radius, wave = 3.0, 32
    union = torch.zeros_like(points)
    union[:, 2] = torch.cos(2 * torch.pi * x / (wave * SPACING)).reshape(-1)
    found = published(lattice, union, radius)[:, 2].reshape(160, 5)[32:128]
    share = (found * union[:, 2].reshape(160, 5)[32:128]).sum()
    share = share / union[:, 2].reshape(160, 5)[32:128].square().sum()
    wanted = 1 / (1 + (2 * torch.pi * radius / wave) ** 2)
    assert_close(share, torch.tensor(wanted).double(), atol=0.01, rtol=0)  # finite elements


def robust(lattice, union, radius, scale, limit=200, tolerance=1e-9):
    fidelity = torch.full((2,), (radius * SPACING) ** -2, dtype=torch.float64)
    trends, fitted = facet_trends(lattice, union, everywhere(lattice), 2)

    def solve(stiffness):
        parts = assemble(lattice, fidelity, everywhere(lattice), stiffness)
        rhs = parts.mass[:, None] * union
        rhs = rhs + plane_pull(lattice, trends, fitted, stiffness, scale)
        return SparseCholesky(parts.rows, parts.cols, parts.values, size=len(union)).solve(rhs)

    def deviation(places):
        return trend_deviation(lattice, places, trends)

    start = torch.ones(len(lattice.faces), dtype=torch.float64)
    found, _, cause = reweighted(
        solve,
        deviation,
        start,
        scale=scale,
        tolerance=torch.tensor(tolerance, dtype=torch.float64),
        limit=limit,
    )
    assert cause == StopCause.CONVERGED
    return found, trends


def test_slopes_of_faces_are_those_of_an_affine_map(square):
    generator = torch.Generator().manual_seed(93)
    tilt = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    found = face_slopes(square, square.points @ tilt.T)
    flat = torch.diag(torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64))
    assert_close(found, (tilt @ flat).expand(len(found), 3, 3))
    off = trend_deviation(square, square.points @ tilt.T, tilt.expand(2, 3, 3))
    assert_close(off, torch.zeros_like(off), atol=1e-12, rtol=0)


def test_reweighting_ends_where_the_robust_energys_gradient_vanishes(square):
    generator = torch.Generator().manual_seed(94)
    noise = torch.randn(len(square.points), generator=generator, dtype=torch.float64)
    union = square.points.clone()
    # One slope on both facets, so that no crease pulls and the energy is the printed one.
    union[:, 2] = 0.3 * union[:, 0] + 0.03 * noise
    scale, radius = 0.1, 2.0
    trends = facet_trends(square, union, everywhere(square), 2)[0].mean(dim=0, keepdim=True)
    fitted = torch.zeros(2, dtype=torch.bool)
    fidelity = torch.full((2,), (radius * SPACING) ** -2, dtype=torch.float64)

    def solve(stiffness):
        parts = assemble(square, fidelity, everywhere(square), stiffness)
        rhs = parts.mass[:, None] * union
        rhs = rhs + plane_pull(square, trends.expand(2, 3, 3), fitted, stiffness, scale)
        return SparseCholesky(parts.rows, parts.cols, parts.values, size=len(union)).solve(rhs)

    def deviation(places):
        return trend_deviation(square, places, trends.expand(2, 3, 3))

    found, solves, cause = reweighted(
        solve,
        deviation,
        torch.ones(len(square.faces), dtype=torch.float64),
        scale=scale,
        tolerance=torch.tensor(1e-10, dtype=torch.float64),
        limit=300,
    )
    assert cause == StopCause.CONVERGED
    assert solves > 3
    places = found.clone().requires_grad_()
    weights = seam_weight(square.barycentric)
    corners = square.points[square.faces]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = area.norm(dim=-1) / 2
    apart = (1 - weights) * (union - places).square().sum(dim=-1) / (radius * SPACING) ** 2
    psi = 2 * scale**2 * ((1 + (deviation(places) / scale).square()).sqrt() - 1)
    smooth = weights[square.faces].mean(dim=1) * psi
    energy = (area * (apart[square.faces].mean(dim=1) + smooth)).sum()
    (gradient,) = torch.autograd.grad(energy, places)
    size = (radius * SPACING) ** -2 * float(area.max())
    assert gradient.abs().max() < 1e-6 * size


def test_a_crease_is_kept_by_robust_smoothness_and_rounded_by_the_quadratic(square):
    ridge = square.points.clone()
    ridge[:, 2] = (ridge[:, 0] - ridge[:, 1]).abs()  # along the seam, 45 degrees to each side
    generator = torch.Generator().manual_seed(95)
    noise = 0.003 * torch.randn(len(ridge), generator=generator, dtype=torch.float64)
    union = ridge.clone()
    union[:, 2] += noise
    radius = 2.0
    quadratic, _ = robust(square, union, radius, 1e6)
    kept, _ = robust(square, union, radius, 0.05)
    on_seam = (square.points[:, 0] - square.points[:, 1]).abs() < 1e-9
    away = (quadratic - ridge)[on_seam, 2].abs().mean()
    assert away > 0.3 * SPACING
    assert (kept - ridge)[on_seam, 2].abs().mean() < 0.4 * away
    # Noise beside the ridge, where G is large, is removed all the same.
    near = (seam_weight(square.barycentric) > 0.4) & ~on_seam
    near &= (square.points[:, 0] - square.points[:, 1]).abs() > 0.3
    assert (kept - ridge)[near, 2].std() < 0.7 * noise[near].std()


def test_small_slopes_are_smoothed_as_the_quadratic_does(square):
    generator = torch.Generator().manual_seed(96)
    union = square.points.clone()
    union[:, 2] += 1e-4 * torch.randn(len(union), generator=generator, dtype=torch.float64)
    kept, _ = robust(square, union, 2.0, 0.5)
    quadratic, _ = robust(square, union, 2.0, 1e6)
    assert_close(kept, quadratic, atol=1e-6, rtol=0)


def test_planes_stay_what_they_are_under_robust_smoothness(square):
    union = square.points.clone()
    union[:, 2] = 0.7 * union[:, 0] - 0.4 * union[:, 1]
    kept, _ = robust(square, union, 3.0, 0.05)
    assert_close(kept, union, atol=1e-9, rtol=0)


def test_weights_fall_with_the_deviation_as_the_function_says():
    deviation = torch.linspace(0, 3, 7, dtype=torch.float64, requires_grad=True)
    scale = 0.4
    psi = 2 * scale**2 * ((1 + (deviation / scale).square()).sqrt() - 1)
    (slope,) = torch.autograd.grad(psi.sum(), deviation)
    assert_close(charbonnier_weight(deviation, scale) * 2 * deviation, slope)


def test_robust_refinement_reports_its_solves_and_has_gradients(cap):
    config = RefineConfig(smoothness="robust", smoothing_radius_samples=1.0)
    depth = [bucket.depth.clone().requires_grad_() for bucket in cap.buckets]
    buckets = tuple(
        bucket.replace(depth=own) for bucket, own in zip(cap.buckets, depth, strict=True)
    )
    surface = Refine(config)(cap.replace(buckets=buckets))
    assert surface.convergence.converged.all()
    assert 1 < int(surface.convergence.iterations) < 40
    surface.vertices_world[:, 2].square().sum().backward()
    assert all(own.grad is not None and own.grad.isfinite().all() for own in depth)
    assert sum(float(own.grad.abs().sum()) for own in depth) > 0
    centre = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    plain = Refine(RefineConfig(smoothing_radius_samples=1.0))(cap)

    def off(vertices):
        return ((vertices.detach() - centre).norm(dim=-1) - 1).abs().mean()

    assert off(surface.vertices_world) < 1.1 * off(plain.vertices_world)


def test_robust_smoothness_without_trends_is_refused():
    with pytest.raises(ConfigError, match="smoothness"):
        RefineConfig(smoothness="robust", hold_planes=False)
