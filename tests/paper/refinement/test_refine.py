import torch
from torch.testing import assert_close

from pimper_torch.ground.geometry.subdivision import subdivide
from pimper_torch.ground.geometry.surfaces import unit_face_normals
from pimper_torch.ground.geometry.topology import half_edges
from pimper_torch.method.fusion.blend import blend_patches, ray_directions, vertex_spacing
from pimper_torch.paper.paper_config import RefineConfig
from pimper_torch.paper.refine import Refine

SPACING = 0.02


def plane(x, y):
    return 0.3 * x - 0.2 * y


def changed(depths, change):
    """Replace the height field of every bucket by ``change(templates, height field)``."""
    buckets = tuple(
        height_field.replace(**change(templates, height_field))
        for templates, height_field in zip(depths.patches.buckets, depths.buckets, strict=True)
    )
    return depths.replace(buckets=buckets)


def shifted(depths, facets, by):
    """Move some patches along their z."""

    def change(templates, height_field):
        chosen = torch.isin(templates.facet, torch.tensor(facets))
        return {"depth": height_field.depth + by * chosen[:, None, None]}

    return changed(depths, change)


def united(depths):
    mesh = depths.patches.coarse.mesh
    subdivision = subdivide(mesh.vertices_world, mesh.faces, vertex_spacing(depths.patches, 1.0))
    directions = ray_directions(subdivision, depths.patches.coarse)
    blend = blend_patches(depths, subdivision, directions, torch.inf)
    return subdivision, blend, subdivision.points + blend.heights[:, None] * directions


def off_sphere(points):
    centre = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return (points - centre).norm(dim=-1) - 1


def test_exact_height_field_on_a_cap_gives_the_sphere_back(cap):
    subdivision, blend, points = united(cap)
    assert blend.supported.all()
    flat = off_sphere(subdivision.points).abs().mean()
    # Bilinear cells sag by spacing^2 / 4 = 1e-4.
    assert off_sphere(points).abs().max() < 1.5e-4
    for radius, factor in ((1.0, 12), (2.0, 4)):  # smoothing flattens by about r^2 / 2 cells
        surface = Refine(RefineConfig(smoothing_radius_samples=radius))(cap)
        assert off_sphere(surface.vertices_world).abs().mean() < flat / factor


def test_normals_albedo_and_information_come_from_the_patches(cap):
    surface = Refine(RefineConfig(smoothing_radius_samples=1.0))(cap)
    centre = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    _, _, points = united(cap)
    radial = torch.nn.functional.normalize(points - centre, dim=-1)
    assert (surface.normals_world * radial).sum(-1).min() > 1 - 1e-5
    assert_close(surface.normals_world.norm(dim=-1), torch.ones(len(radial)).double())
    albedo = 0.5 + 0.25 * points
    assert_close(surface.albedo, albedo, atol=0.25 * SPACING, rtol=0)
    assert_close(surface.information, torch.full((len(radial),), 1e3).double())
    assert surface.convergence.converged.all()


def test_the_union_is_continuous_across_a_step_between_patches(builder):
    depths = builder.patches(builder.coarse(plane, rings=1), plane)
    step = 4 * SPACING
    subdivision, _, points = united(shifted(depths, [0, 2], step))
    edges = half_edges(subdivision.faces)
    heights = points[:, 2] - plane(points[:, 0], points[:, 1])
    jump = (heights[edges[:, 0]] - heights[edges[:, 1]]).abs()
    assert heights.abs().max() > 0.9 * step
    # The blend spans nine samples with smoothstep's steepest slope, 1.5; and a diagonal.
    assert jump.max() < 0.3 * step


def test_steps_at_seams_are_smoothed_and_the_centre_of_facets_is_kept(builder):
    depths = builder.patches(builder.coarse(plane, rings=1), plane, overlap=2.0)
    step = 3 * SPACING
    stepped = shifted(depths, [0, 2, 4], step)
    subdivision, _, points = united(stepped)
    surface = Refine(RefineConfig(smoothing_radius_samples=2.0))(stepped)
    edges = torch.unique(half_edges(subdivision.faces).sort(dim=1).values, dim=0)

    def steepest(vertices):
        height = vertices[:, 2] - plane(vertices[:, 0], vertices[:, 1])
        return (height[edges[:, 0]] - height[edges[:, 1]]).abs().max()

    assert steepest(surface.vertices_world) < 0.4 * steepest(points)
    moved = (surface.vertices_world - points).norm(dim=-1)
    centre = (subdivision.barycentric - 1 / 3).abs().amax(dim=1) < 0.05
    seam = (subdivision.barycentric.amin(dim=1) < 0.02) & (
        subdivision.barycentric.amax(dim=1) < 0.8
    )
    assert moved[centre].max() < 0.2 * moved[seam].max()


def test_a_hole_in_the_height_field_is_filled_and_marked(cap):
    def change(templates, height_field):
        world = templates.points_patch @ templates.patch_from_world[:, None, :3, :3]
        offset = templates.patch_from_world[:, :3, :3].mT @ templates.patch_from_world[:, :3, 3:]
        x, y = (world - offset.mT[:, None])[..., :2].unbind(-1)
        away = (x - 0.15).square() + (y - 0.1).square() < 0.08**2
        return {
            "valid": height_field.valid & ~away,
            "depth": torch.where(away, torch.nan, height_field.depth),
        }

    surface = Refine(RefineConfig(smoothing_radius_samples=1.0))(changed(cap, change))
    empty = surface.information == 0
    assert 20 < empty.sum() < 120
    for part in (surface.vertices_world, surface.normals_world, surface.albedo):
        assert part.isfinite().all()
    # A soap film over a hole of radius 0.1, a sample wider than ours, sags by 0.1^2 / 2.
    assert off_sphere(surface.vertices_world)[empty].abs().max() < 0.008
    assert_close(surface.normals_world.norm(dim=-1), torch.ones(len(empty)).double())


def test_height_field_that_is_valid_nowhere_leaves_the_facets_without_confidence(cap):
    nowhere = changed(cap, lambda _, height_field: {"valid": torch.zeros_like(height_field.valid)})
    surface = Refine()(nowhere)
    mesh = nowhere.patches.coarse.mesh
    flat = subdivide(mesh.vertices_world, mesh.faces, vertex_spacing(nowhere.patches, 1.0))
    assert surface.vertices_world.shape == flat.points.shape
    away = surface.vertices_world - flat.points
    assert away.norm(dim=1).max() < 3 * SPACING  # seams are smoothed, nothing else
    off_facet = (away * unit_face_normals(mesh.vertices_world, mesh.faces)[flat.facet]).sum(dim=1)
    assert off_facet.abs().median() < 0.2 * SPACING
    assert (surface.confidence == 0).all()
