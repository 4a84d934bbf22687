import pytest
import torch
from scenes import subdivided_square
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_bench.derivatives import check_derivatives
from pimper_torch.geometry.topology import face_edges
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import ContourPoints, FacetPoints
from pimper_torch.stages.fusion.equations import (
    BaseSurface,
    SharedError,
    cloud_points,
    contour_tangents,
    kept_slopes,
    kept_steps,
    passing,
    slopes,
    swept_heights,
    upright_edges,
)

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def base(subdivision, heights, directions=UP, points=None, reach=1.0, finest=1e-9):
    """Return the subdivided mesh with heights along directions."""
    return BaseSurface(
        points=subdivision.points if points is None else points,
        faces=subdivision.faces,
        facet=subdivision.facet,
        heights=heights,
        directions=directions.expand(len(heights), 3),
        reach=reach,
        finest=finest,
    )


def equations_of(contacts, known, surface):
    """Return the equations of points of a surface."""
    caster = RayCaster(surface.points, surface.faces)
    return passing(contacts(known, surface), surface, caster)


@pytest.fixture
def subdivision():
    return subdivided_square(0.1)


def paraboloid(points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return heights and unnormalized normals of a surface with linear slopes."""
    x, y = points[:, 0], points[:, 1]
    height = 0.3 * x - 0.1 * y + 0.2 * x * x + 0.15 * x * y - 0.1 * y * y
    slope = torch.stack([0.3 + 0.4 * x + 0.15 * y, -0.1 + 0.15 * x - 0.2 * y], dim=1)
    return height, torch.cat([-slope, torch.ones_like(slope[:, :1])], dim=1)


def test_slopes_are_satisfied_by_their_surface_only(subdivision):
    height, normals = paraboloid(subdivision.points)
    along = UP.expand(len(height), 3)
    edges = face_edges(subdivision.faces)[0]
    ones = torch.ones_like(height)
    found = slopes(edges, subdivision.points, along, normalize(normals, dim=1), 1e-4 * ones)
    # Means of unit normals and of slopes agree to third order in the edge length.
    assert found.residual(height).abs().max() < 1e-4
    assert_close(found.residual(height + 0.7), found.residual(height), rtol=0, atol=1e-3)
    assert found.residual(1.1 * height).abs().median() > 1e-3


def test_variances_of_slopes_grow_with_squared_edge_length(subdivision):
    along = UP.expand(len(subdivision.points), 3)
    edges = face_edges(subdivision.faces)[0]
    variance = torch.full_like(subdivision.points[:, 0], 4e-4)
    found = slopes(edges, subdivision.points, along, along, variance)
    length = (subdivision.points[edges[:, 1]] - subdivision.points[edges[:, 0]]).norm(dim=1)
    assert_close(1 / found.information, 4e-4 * length.square())
    common = SharedError(variance=variance[0] / 2, count=torch.full_like(variance, 6.0))
    together = slopes(edges, subdivision.points, along, along, variance, common)
    assert_close(together.information, found.information / 4)
    # The variance of an edge is its own plus the shared one: 1.5 of the 4.
    assert_close(together.correlated, torch.full_like(length, 4.0 / 1.5))


def test_kept_slopes_are_those_of_the_current_surface(subdivision, generator):
    height = torch.rand(len(subdivision.points), generator=generator, dtype=torch.float64)
    along = UP.expand(len(height), 3)
    edges = face_edges(subdivision.faces)[0]
    found = kept_slopes(edges, subdivision.points, along, along, height, 0.01 + 0 * height)
    assert_close(found.residual(height), torch.zeros(len(edges)).double())
    assert_close(found.residual(height + 3), torch.zeros(len(edges)).double(), rtol=0, atol=1e-12)
    assert not found.evaluated


def test_edges_across_a_contour_are_not_upright(subdivision):
    edges = face_edges(subdivision.faces)[0]
    across = subdivision.points[:, 0] - 0.45  # from the contour
    along = UP.expand(len(across), 3)
    lean = torch.stack([torch.ones_like(across), 0 * across, across], dim=1)
    both = (lean[edges].sum(dim=1)[:, 2] > 0.25).numpy()  # clearly on the visible side
    found = upright_edges(edges, along, normalize(lean, dim=1)).numpy()
    assert found[both].all()
    assert not found[(across[edges] < 0).any(dim=1).numpy() & ~both].any()
    # Nor are edges with opposite normals, or with an opposite direction at one end.
    assert not upright_edges(edges, along, -along).any()
    rotated = along.clone()
    rotated[0] = -UP
    assert torch.equal(~upright_edges(edges, rotated, along), (edges == 0).any(dim=1))


def test_kept_steps_are_those_of_the_current_surface(subdivision, generator):
    height = torch.rand(len(subdivision.points), generator=generator, dtype=torch.float64)
    edges = face_edges(subdivision.faces)[0]
    found = kept_steps(edges, subdivision.points, height, 0.01)
    assert_close(found.residual(height + 3), torch.zeros(len(edges)).double(), rtol=0, atol=1e-12)
    assert found.residual(1.1 * height).abs().max() > 0.01
    along = UP.expand(len(height), 3)
    flat = kept_slopes(edges, subdivision.points, along, along, height, 0.01 + 0 * height)
    assert_close(found.information, flat.information)
    assert not found.evaluated


def test_offsets_along_oblique_normals_are_longer_along_the_direction():
    transferred = torch.tensor([1.0, 1.0, 1.0], dtype=torch.float64)
    offsets = torch.tensor([0.1, 0.1, 0.1], dtype=torch.float64)
    information = torch.tensor([4.0, 4.0, 0.0], dtype=torch.float64)
    facing = torch.tensor([1.0, 0.5, 1.0], dtype=torch.float64)
    found = swept_heights(transferred, offsets, information, facing, torch.full_like(facing, 25.0))
    assert found.unknowns.flatten().tolist() == [0, 1]
    assert_close(found.targets, torch.tensor([1.1, 1.2], dtype=torch.float64))
    assert_close(found.information, torch.tensor([4.0, 1.0], dtype=torch.float64))


def test_the_shared_error_of_heights_bounds_their_information():
    count = 1000
    nothing = torch.zeros(count, dtype=torch.float64)
    own = torch.full_like(nothing, 25.0)
    common = SharedError(variance=torch.tensor(0.01).double(), count=torch.full_like(own, count))
    terms = nothing, nothing, own, torch.ones_like(own), torch.full_like(own, 4.0)
    alone, found = swept_heights(*terms), swept_heights(*terms, common)
    assert_close(alone.information.sum(), own.sum())
    # The variance of the mean is that of the independent errors plus the shared one.
    assert_close(1 / found.information.sum(), 1 / own.sum() + common.variance)
    # The variance of one height is its own, over its window, plus the shared one.
    assert_close(1 / (found.information * found.correlated), 1 / (4 * own) + common.variance)


def test_equations_of_cloud_points_pass_the_surface_through_them(subdivision, generator):
    along = normalize(UP + 0.1 * (subdivision.points - 0.5), dim=1)  # directions fan out
    xy = 0.1 + 0.8 * torch.rand(40, 2, generator=generator, dtype=torch.float64)
    lift = 0.05 * (torch.rand(40, 1, generator=generator, dtype=torch.float64) - 0.5)
    points = torch.cat([xy, lift], dim=1)
    covariance = torch.diag(torch.tensor([1.0, 1.0, 1e-4])).double().expand(40, 3, 3)
    cloud = FacetPoints(
        points_world=points, covariance_world=covariance, facet=torch.zeros(40, dtype=torch.long)
    )
    surface = base(subdivision, torch.zeros_like(along[:, 0]), along)
    found = equations_of(cloud_points, cloud, surface)
    assert len(found.targets) == 40
    assert found.unknowns.shape == (40, 1)
    assert_close(found.coefficients, torch.ones(40, 1).double())
    assert_close(found.targets, lift[:, 0], rtol=0.02, atol=1e-4)
    # At the vertex next to it: vertices are 0.1 apart.
    off = (subdivision.points[found.unknowns[:, 0], :2] - xy).norm(dim=1)
    assert off.max() < 0.1
    # On a tilted surface, the height is the offset at the point.
    leaning = subdivision.points + (0.3 * subdivision.points[:, :1]) * UP
    raised = torch.cat([xy, 0.3 * xy[:, :1] + 0.02], dim=1)
    above = equations_of(
        cloud_points,
        cloud.replace(points_world=raised),
        surface.replace(points=leaning, heights=leaning[:, 2], directions=UP.expand_as(along)),
    )
    assert_close(above.targets - leaning[above.unknowns[:, 0], 2], torch.full((40,), 0.02).double())
    # Uncertain laterally, certain along the direction: only lateral errors on slanted lines count.
    assert (1 / found.information < 0.05).all()
    assert (1 / found.information >= 1e-4).all()
    near = equations_of(cloud_points, cloud, surface.replace(reach=0.01))
    assert len(near.targets) == int((lift.abs() <= 0.01 / 1.0).sum())


def test_contours_are_tangent_planes(subdivision, generator):
    # A tilted plane with oblique directions.
    slope = 0.3
    tilted = subdivision.points + (slope * subdivision.points[:, :1]) * UP
    normal = normalize(torch.tensor([-slope, 0.0, 1.0]).double(), dim=0)
    along = normalize(torch.tensor([0.2, 0.1, 1.0]).double(), dim=0)
    surface = base(subdivision, torch.zeros_like(tilted[:, 0]), along, tilted)
    centre = torch.tensor([0.5, 0.5, 0.15]).double()
    ray = torch.linalg.cross(normal, normalize(torch.randn(3, generator=generator).double(), dim=0))
    # The position on the ray does not matter: it is 0.04 above the plane everywhere.
    shifts = 0.2 * (torch.rand(30, 1, generator=generator, dtype=torch.float64) - 0.5)
    points_world = centre + 0.04 * normal + shifts * normalize(ray, dim=0)
    contours = ContourPoints(
        points_world=points_world,
        normals_world=normal.expand(30, 3),
        variance=torch.full((30,), 1e-4).double(),
        view=torch.zeros(30, dtype=torch.long),
        ray=torch.arange(30),
    )
    found = equations_of(contour_tangents, contours, surface)
    facing = float(along @ normal)
    assert_close(found.targets, torch.full((30,), 0.04 / facing).double())
    assert_close(1 / found.information, torch.full((30,), 1e-4 / facing**2).double())
    # Heights cannot reach a plane parallel to their direction: no equations.
    beside = contours.replace(normals_world=torch.tensor([0.0, 1.0, 0.0]).double().expand(30, 3))
    assert len(equations_of(contour_tangents, beside, surface).targets) == 0


def test_contour_targets_do_not_move_with_the_surface(subdivision, generator):
    height = 0.1 * torch.rand(len(subdivision.points), generator=generator, dtype=torch.float64)
    points_world = subdivision.points[5:-5:7] * 0.9 + torch.tensor([0.03, 0.04, 0.2]).double()
    leaning = UP + 0.2 * torch.randn(points_world.shape, generator=generator, dtype=torch.float64)
    contours = ContourPoints(
        points_world=points_world,
        normals_world=normalize(leaning, dim=1),
        variance=torch.full_like(points_world[:, 0], 1e-4),
        view=torch.zeros(len(points_world), dtype=torch.long),
        ray=torch.arange(len(points_world)),
    )

    def term(x):
        along = normalize(x["directions"], dim=1)
        raised = x["heights"] + x["all"]
        lifted = subdivision.points + raised[:, None] * UP
        surface = base(subdivision, raised, along, lifted, reach=9.0, finest=1e-3)
        found = equations_of(contour_tangents, contours, surface)
        return {"target": found.targets, "information": found.information}

    inputs = {
        "heights": height,
        "all": torch.zeros(()).double(),
        "directions": UP.expand(len(height), 3).clone(),
    }
    checks = check_derivatives(term, inputs, generator)
    assert checks["heights", "target"].spread < 1e-5
    assert checks["directions", "target"].spread < 1e-5
    assert checks["directions", "information"].spread < 1e-5
    # Raising all heights along upright directions moves the entire surface by the same amount.
    assert checks["all", "target"].analytic.abs().max() < 1e-9
    assert checks["all", "target"].numeric.abs().max() < 1e-6
