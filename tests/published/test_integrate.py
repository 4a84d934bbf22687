import pytest
import torch
from draws import normal
from slopes import normals_from_slopes
from torch.testing import assert_close

from pimper_torch.geometry.height_fields import sample_raster
from pimper_torch.geometry.rigid import transform
from pimper_torch.paper.integrate import (
    Integrate,
    differences,
    differences_transposed,
    fill_smoothly,
    integrate_normals,
    solve_poisson,
)
from pimper_torch.records import PhotometricPatches
from tests.published.scenes import IDENTITY, facets_over


def two_facets(sample, dtype=torch.float64):
    """Return a square of two facets of different tilt."""
    corners = torch.tensor([[0.0, 0], [1, 0], [1.1, 1], [0, 0.9]], dtype=torch.float64)
    return facets_over(lambda x, y: 0.1 * (x - y).abs(), corners, sample, 3.0, dtype)


def photographed(patches, slopes, keep=lambda x, y: torch.ones_like(x, dtype=torch.bool)):
    """Give patches the exact normals of a height field with the slopes ``(x, y) -> (p, q)``."""
    normals = []
    for templates in patches.buckets:
        x, y, _ = templates.points_patch.unbind(dim=-1)
        exact = normals_from_slopes(torch.stack(slopes(x, y), dim=-1))
        normals.append(torch.where(keep(x, y)[..., None], exact, torch.nan))
    return PhotometricPatches.of(patches, normals=normals, lights=torch.ones(1, 4))


def bumps(x, y):
    return 0.2 * x * x + 0.1 * x * y + 0.02 * torch.sin(6 * x) * torch.cos(5 * y)


def slopes_of_bumps(x, y):
    p = 0.4 * x + 0.1 * y + 0.12 * torch.cos(6 * x) * torch.cos(5 * y)
    q = 0.1 * x - 0.1 * torch.sin(6 * x) * torch.sin(5 * y)
    return p, q


def test_the_error_of_closed_form_surfaces_is_of_second_order():
    def misfit(count):
        axis = torch.linspace(-0.5, 0.5, count, dtype=torch.float64)
        y, x = torch.meshgrid(axis, axis, indexing="ij")
        normals = normals_from_slopes(torch.stack(slopes_of_bumps(x, y), dim=-1))[None]
        everywhere = torch.ones(1, count, count, dtype=torch.bool)
        depth = integrate_normals(normals, everywhere, axis[1:2] - axis[:1], 4.0)[0]
        off = depth - bumps(x, y)
        return float((off - off.mean()).abs().max())

    coarse, fine = misfit(20), misfit(39)
    assert coarse < 2e-3  # of a height field 0.2 high
    assert fine < 0.4 * coarse


def test_a_tilted_plane_stays_a_plane_to_float32_rounding():
    patches = two_facets(0.025, dtype=torch.float32)
    seen = photographed(patches, lambda x, y: (0 * x + 0.8, 0 * x - 0.3))
    for templates, height_field in zip(patches.buckets, Integrate()(seen).buckets, strict=True):
        x, y, _ = templates.points_patch.unbind(dim=-1)
        plane = 0.8 * x - 0.3 * y
        rest = height_field.depth - plane
        rest = rest - rest.mean(dim=(1, 2), keepdim=True)
        assert rest.abs().max() < 4 * torch.finfo(torch.float32).eps * plane.abs().max()


def test_holes_are_bridged_smoothly():
    patches = two_facets(0.025)
    seen = photographed(patches, slopes_of_bumps, keep=lambda x, y: x**2 + y**2 > 0.1**2)
    for templates, height_field in zip(patches.buckets, Integrate()(seen).buckets, strict=True):
        assert (height_field.valid == templates.inside).all()
        for patch, points in enumerate(templates.points_patch):
            x, y, _ = points.unbind(dim=-1)
            misfit = (height_field.depth[patch] - bumps(x, y))[x**2 + y**2 <= 0.1**2]
            # Over a hole 0.2 wide, the bumps deviate from a plane by 0.01; the bridge is closer.
            assert (misfit - misfit.mean()).abs().max() < 0.005


def test_a_patch_without_normals_stays_flat_and_is_marked():
    seen = photographed(two_facets(0.05), slopes_of_bumps, lambda x, y: torch.zeros_like(x) > 0)
    for height_field in Integrate()(seen).buckets:
        assert_close(height_field.depth, torch.zeros_like(height_field.depth))
        assert not height_field.valid.any()


def test_the_height_field_has_mean_zero_at_the_corners():
    depths = Integrate()(photographed(two_facets(0.05), slopes_of_bumps))
    mesh = depths.patches.coarse.mesh
    for templates, field in zip(depths.patches.buckets, depths.buckets, strict=True):
        vertices = mesh.vertices_world[mesh.faces[templates.facet]]
        corners = transform(templates.patch_from_world, vertices)[..., :2]
        grid = templates.origin, templates.spacing
        found = sample_raster(field.depth[:, None], corners, *grid)[:, 0]
        assert found.abs().max() > 1e-3  # only the mean is zero
        assert_close(found.mean(dim=1), torch.zeros_like(found[:, 0]))
        assert_close(field.transform, IDENTITY.expand(len(found), 4))


def test_the_solution_equals_dense_least_squares_on_steps(generator):
    """Steps of the solution are closest to the given ones, for any source of zero mean."""
    right, down = normal(generator, 5, 5), normal(generator, 4, 6)
    unit = torch.eye(30, dtype=torch.float64).reshape(-1, 5, 6)
    steps = torch.cat([part.flatten(1) for part in differences(unit)], dim=1).T
    wanted = torch.cat([right.flatten(), down.flatten()])
    dense = torch.linalg.lstsq(steps, wanted[:, None], driver="gelsd").solution.reshape(5, 6)
    source = differences_transposed(right, down)
    assert_close(source.flatten(), steps.T @ wanted)  # the adjoint of differences
    assert_close(solve_poisson(source + 3), dense - dense.mean())


def test_filling_keeps_known_values_and_ignores_unknown_ones(generator):
    weight = (torch.rand(2, 9, 14, generator=generator) < 0.3).double()
    values = normal(generator, 2, 3, 9, 14)
    filled = fill_smoothly(torch.where(weight[:, None] > 0, values, torch.nan), weight)
    assert filled.isfinite().all()
    known = (weight[:, None] > 0).expand_as(values)
    assert_close(filled[known], values[known])


@pytest.mark.parametrize(("seen", "value"), [(1, 0.7), (0, 0.0)])
def test_filling_spreads_a_single_sample_and_is_zero_without_one(seen, value):
    weight = torch.zeros(1, 11, 6)
    weight[0, 7, 1] = seen
    values = torch.where(weight[:, None] > 0, 0.7, torch.nan).expand(1, 2, 11, 6)
    assert_close(fill_smoothly(values, weight), torch.full((1, 2, 11, 6), value))


def test_filled_values_are_between_their_neighbours():
    values, weight = torch.zeros(1, 1, 16, 16), torch.ones(1, 16, 16)
    values[..., 12:] = 1
    weight[:, :, 4:12] = 0
    filled = fill_smoothly(values, weight)[0, 0, 8]
    assert ((filled >= 0) & (filled <= 1)).all()
    assert filled[5] < 0.3
    assert filled[10] > 0.7
    assert (filled.diff() >= 0).all()
