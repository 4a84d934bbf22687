import torch
from slopes import normals_from_slopes
from torch.testing import assert_close

from pimper_torch.ground.geometry.height_fields import sample_raster
from pimper_torch.ground.geometry.rigid import transform
from pimper_torch.paper.integrate import Integrate, integrate_normals


def bumps(x, y):
    return 0.2 * x * x + 0.1 * x * y + 0.02 * torch.sin(6 * x) * torch.cos(5 * y)


def slopes_of_bumps(x, y):
    p = 0.4 * x + 0.1 * y + 0.12 * torch.cos(6 * x) * torch.cos(5 * y)
    q = 0.1 * x - 0.1 * torch.sin(6 * x) * torch.sin(5 * y)
    return p, q


def worst_misfit(depths, keep=None):
    """Largest distance to the bumps, each patch shifted along z to fit."""
    worst = 0.0
    for templates, height_field in zip(depths.patches.buckets, depths.buckets, strict=True):
        x, y, _ = templates.points_patch.unbind(dim=-1)
        for patch in range(len(x)):
            chosen = height_field.valid[patch] if keep is None else keep(x[patch], y[patch])
            misfit = (height_field.depth[patch] - bumps(x[patch], y[patch]))[chosen]
            worst = max(worst, float((misfit - misfit.mean()).abs().max()))
    return worst


def test_closed_form_surfaces_return_with_an_error_that_falls_with_the_square_of_the_spacing():
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


def test_a_tilted_plane_stays_a_plane_to_float32_rounding(two_facets, photographed):
    patches = two_facets(2.0, dtype=torch.float32)

    def slopes(x, y):
        return torch.full_like(x, 0.8), torch.full_like(x, -0.3)

    depths = Integrate()(photographed(patches, slopes))
    for templates, height_field in zip(patches.buckets, depths.buckets, strict=True):
        x, y, _ = templates.points_patch.unbind(dim=-1)
        plane = 0.8 * x - 0.3 * y
        rest = height_field.depth - plane
        rest = rest - rest.mean(dim=(1, 2), keepdim=True)
        assert rest.abs().max() < 4 * torch.finfo(torch.float32).eps * plane.abs().max()


def test_holes_are_bridged_in_keeping_with_their_rim(two_facets, photographed):
    patches = two_facets(2.0)

    def outside_hole(x, y):
        return (x**2 + y**2) > 0.1**2

    depths = Integrate()(photographed(patches, slopes_of_bumps, keep=outside_hole))
    assert all(
        (d.valid == t.inside).all() for d, t in zip(depths.buckets, patches.buckets, strict=True)
    )
    # Over a hole 0.2 wide, the bumps leave a plane by 0.01; the bridge does better.
    assert worst_misfit(depths, keep=lambda x, y: ~outside_hole(x, y)) < 0.005


def test_a_patch_without_normals_stays_its_facet_and_says_so(two_facets, photographed):
    patches = two_facets(1.0)
    seen = photographed(patches, slopes_of_bumps, keep=lambda x, y: torch.zeros_like(x) > 0)
    for height_field in Integrate()(seen).buckets:
        assert_close(height_field.depth, torch.zeros_like(height_field.depth))
        assert not height_field.valid.any()


def test_the_height_field_passes_on_average_through_the_corners(two_facets, photographed):
    depths = Integrate()(photographed(two_facets(1.0), slopes_of_bumps))
    mesh = depths.patches.coarse.mesh
    for templates, height_field in zip(depths.patches.buckets, depths.buckets, strict=True):
        corners = transform(
            templates.patch_from_world, mesh.vertices_world[mesh.faces[templates.facet]]
        )
        found = sample_raster(
            height_field.depth[:, None], corners[..., :2], templates.origin, templates.spacing
        )[:, 0]
        assert found.abs().max() > 1e-3  # so that only the mean can be zero
        assert_close(found.mean(dim=1), torch.zeros_like(found[:, 0]))
        identity = torch.tensor([0.0, 0, 1, 0], dtype=torch.float64)
        assert_close(height_field.transform, identity.expand(len(found), 4))
