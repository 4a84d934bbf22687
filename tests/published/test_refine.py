import pytest
import torch
from scenes import subdivided_square
from torch.testing import assert_close

from pimper_torch.geometry.subdivision import subdivide
from pimper_torch.geometry.surfaces import unit_face_normals
from pimper_torch.geometry.topology import face_edges
from pimper_torch.paper.paper_config import RefineConfig
from pimper_torch.paper.refine import Refine, seam_weight, smooth_seams
from pimper_torch.stages.fusion.blend import blend_patches, ray_directions, vertex_spacing
from tests.published.scenes import ball, changed, facets_over, height_fields, level, rings

SPACING = 0.02


@pytest.fixture(scope="module")
def cap():
    """A cap of the unit sphere around (0, 0, 1), 40 degrees to each side, exact height field."""
    height, height_field = ball(1.0)
    return height_fields(facets_over(height, rings()), height_field)


def plane(x, y):
    return 0.3 * x - 0.2 * y


def lifted(step, facets, overlap=6.0):
    """Return six coplanar facets, some of which are lifted along their z."""
    depths = height_fields(facets_over(plane, rings(count=1), overlap=overlap), level)

    def change(templates, field):
        chosen = torch.isin(templates.facet, torch.tensor(facets))
        return {"depth": field.depth + step * chosen[:, None, None]}

    return changed(depths, change)


def united(depths):
    mesh = depths.patches.coarse.mesh
    subdivision = subdivide(mesh.vertices_world, mesh.faces, vertex_spacing(depths.patches, 1.0))
    directions = ray_directions(subdivision, depths.patches.coarse)
    blend = blend_patches(depths, subdivision, directions, torch.inf)
    return subdivision, blend, subdivision.points + blend.heights[:, None] * directions


def refined(depths, radius):
    return Refine(RefineConfig(smoothing_radius_samples=radius))(depths)


def off_sphere(points):
    return (points - points.new_tensor([0, 0, 1])).norm(dim=-1) - 1


def test_an_exact_height_field_on_a_cap_reproduces_the_sphere(cap):
    subdivision, blend, points = united(cap)
    assert blend.supported.all()
    flat = off_sphere(subdivision.points).abs().mean()
    # Bilinear cells sag by spacing^2 / 4 = 1e-4.
    assert off_sphere(points).abs().max() < 1.5e-4
    for radius, factor in ((1.0, 12), (2.0, 4)):  # smoothing flattens by about r^2 / 2 cells
        assert off_sphere(refined(cap, radius).vertices_world).abs().mean() < flat / factor


def test_normals_albedo_and_information_come_from_the_patches(cap):
    surface, (_, _, points) = refined(cap, 1.0), united(cap)
    radial = torch.nn.functional.normalize(points - points.new_tensor([0, 0, 1]), dim=-1)
    assert (surface.normals_world * radial).sum(-1).min() > 1 - 1e-5
    assert_close(surface.normals_world.norm(dim=-1), torch.ones(len(radial)).double())
    assert_close(surface.albedo, 0.5 + 0.25 * points, atol=0.25 * SPACING, rtol=0)
    assert_close(surface.information, torch.full((len(radial),), 1e3).double())
    assert surface.convergence.converged.all()


def test_the_union_is_continuous_across_a_step_between_patches():
    step = 4 * SPACING
    subdivision, _, points = united(lifted(step, [0, 2]))
    edges, _ = face_edges(subdivision.faces)
    heights = points[:, 2] - plane(points[:, 0], points[:, 1])
    jump = (heights[edges[:, 0]] - heights[edges[:, 1]]).abs()
    assert heights.abs().max() > 0.9 * step
    # The blend spans nine samples; smoothstep's steepest slope is 1.5, along a diagonal.
    assert jump.max() < 0.3 * step


def test_steps_at_seams_are_smoothed_and_the_centre_of_facets_is_kept():
    stepped = lifted(3 * SPACING, [0, 2, 4], overlap=2.0)
    subdivision, _, points = united(stepped)
    surface = refined(stepped, 2.0)
    edges, _ = face_edges(subdivision.faces)

    def steepest(vertices):
        height = vertices[:, 2] - plane(vertices[:, 0], vertices[:, 1])
        return (height[edges[:, 0]] - height[edges[:, 1]]).abs().max()

    assert steepest(surface.vertices_world) < 0.4 * steepest(points)
    moved = (surface.vertices_world - points).norm(dim=-1)
    centre = (subdivision.barycentric - 1 / 3).abs().amax(dim=1) < 0.05
    seam = subdivision.barycentric.amin(dim=1) < 0.02
    seam &= subdivision.barycentric.amax(dim=1) < 0.8
    assert moved[centre].max() < 0.2 * moved[seam].max()


def test_a_hole_in_the_height_field_is_filled_and_marked(cap):
    albedo = iter(bucket.albedo for bucket in cap.photometric.buckets)

    def change(_, field):
        x, y, _ = ((next(albedo) - 0.5) / 0.25).unbind(dim=-1)  # in the world
        away = (x - 0.15).square() + (y - 0.1).square() < 0.08**2
        return {"valid": field.valid & ~away, "depth": field.depth.where(~away, torch.nan)}

    surface = refined(changed(cap, change), 1.0)
    empty = surface.information == 0
    assert 20 < empty.sum() < 120
    for part in (surface.vertices_world, surface.normals_world, surface.albedo):
        assert part.isfinite().all()
    # A soap film over a hole of radius 0.1, one sample wider than this one, sags by 0.1^2 / 2.
    assert off_sphere(surface.vertices_world)[empty].abs().max() < 0.008
    assert_close(surface.normals_world.norm(dim=-1), torch.ones(len(empty)).double())


def test_invalid_height_fields_leave_facets_with_zero_confidence(cap):
    nowhere = changed(cap, lambda _, field: {"valid": torch.zeros_like(field.valid)})
    surface, (flat, _, _) = Refine()(nowhere), united(nowhere)
    mesh = nowhere.patches.coarse.mesh
    away = surface.vertices_world - flat.points
    assert away.norm(dim=1).max() < 3 * SPACING  # only seams are smoothed
    off_facet = (away * unit_face_normals(mesh.vertices_world, mesh.faces)[flat.facet]).sum(dim=1)
    assert off_facet.abs().median() < 0.2 * SPACING
    assert (surface.confidence == 0).all()


def spaced(spacing):
    return torch.full((4,), spacing, dtype=torch.float64)


@pytest.fixture
def folded():
    """Four facets around a centre, lifted like a tent, with edges of different lengths."""
    vertices = [[0.0, 0, 0.4], [1.1, 0, 0], [0.1, 0.9, 0.1], [-0.7, 0.1, 0], [0, -1.3, 0]]
    facets = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]])
    return subdivide(torch.tensor(vertices, dtype=torch.float64), facets, spaced(0.1))


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ([1 / 3, 1 / 3, 1 / 3], 0.0),
        ([0.0, 0.5, 0.5], 0.5),
        ([0.0, 0.0, 1.0], 0.5**0.5),
        ([0.5, 0.25, 0.25], 0.5 * 0.5**0.5),
    ],
)
def test_the_seam_weight_has_the_published_values_at_every_corner(place, value):
    for shift in range(3):
        found = seam_weight(torch.tensor(place, dtype=torch.float64).roll(shift))
        assert float(found) == pytest.approx(value, abs=1e-7)


def test_the_solution_minimises_the_published_energy(folded):
    generator = torch.Generator().manual_seed(81)
    noise = torch.randn(folded.points.shape, generator=generator, dtype=torch.float64)
    union = folded.points + 0.05 * noise
    supported = torch.rand(len(union), generator=generator) < 0.8
    radius, spacing = 2.0, 0.1
    found = smooth_seams(folded, union, supported, spaced(spacing), radius).requires_grad_()

    # The energy per face: gradients of linear functions from edge vectors.
    weights = seam_weight(folded.barycentric)
    corners, values = folded.points[folded.faces], found[folded.faces]
    frame = (corners[:, 1:] - corners[:, :1]).mT
    slope = (values[:, 1:] - values[:, :1]).mT @ torch.linalg.pinv(frame)
    area = torch.linalg.cross(*frame.unbind(dim=-1)).norm(dim=-1) / 2
    apart = (1 - weights) * supported * (union - found).square().sum(-1)
    lumped = apart[folded.faces].mean(dim=1) / (radius * spacing) ** 2
    smooth = weights[folded.faces].mean(dim=1) * slope.square().sum(dim=(1, 2))
    (gradient,) = torch.autograd.grad((area * (lumped + smooth)).sum(), found)
    assert gradient.abs().max() < 1e-7 * (radius * spacing) ** -2 * float(area.max())


def test_vertices_without_support_continue_the_surrounding_plane(folded):
    plane = folded.points.clone()
    plane[:, 2] = 2
    hole = (plane[:, :2] - torch.tensor([0.3, 0.2])).norm(dim=1) < 0.25
    assert hole.sum() > 5
    spoiled = torch.where(hole[:, None], folded.points, plane)
    found = smooth_seams(folded, spoiled, ~hole, spaced(0.1), 2.0)
    assert (found[:, 2] - 2).abs().max() < 1e-6


def test_smoothing_increases_with_g_from_centres_to_seams():
    """White noise is kept entirely at G = 0 and least at the vertices."""
    square, spacing = subdivided_square(0.05), spaced(0.05)[:2]
    noise = torch.randn(
        60, len(square.points), generator=torch.Generator().manual_seed(92)
    ).double()
    kept = torch.zeros_like(noise[0])
    for draw in noise:
        union = torch.stack([0 * draw, 0 * draw, draw], dim=1)
        kept += smooth_seams(square, union, draw == draw, spacing, 0.5)[:, 2] * draw / 60
    inside = (square.barycentric > 0.02).all(dim=1)
    g = seam_weight(square.barycentric)
    centre = (square.barycentric - 1 / 3).abs().amax(dim=1) < 0.04
    assert kept[centre].mean() > 0.7  # neighbours of a vertex already have G = 0.1
    steps = [(0.0, 0.25), (0.25, 0.35), (0.35, 0.45), (0.45, 0.6)]
    fractions = [float(kept[inside & (g >= low) & (g < high)].mean()) for low, high in steps]
    assert fractions == sorted(fractions, reverse=True)
    assert fractions[0] > 1.7 * fractions[-1]
    edge = (square.barycentric.amin(dim=1) < 1e-9) & (g < 0.52)
    corner = square.barycentric.amax(dim=1) > 1 - 1e-9
    assert float(kept[corner].mean()) < float(kept[edge].mean()) < 0.45


def test_smoothing_at_a_seam_has_the_documented_width():
    """With G = 1/2 everywhere, a wave keeps 1 / (1 + (2 pi r / w)^2) of its height."""
    spacing, radius, wave = 0.05, 3.0, 32
    columns = torch.arange(160, dtype=torch.float64) * spacing
    x, y = torch.meshgrid(columns, columns[:5], indexing="ij")
    index = torch.arange(800).reshape(160, 5)
    low = torch.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:]], dim=-1).reshape(-1, 3)
    up = torch.stack([index[:-1, :-1], index[1:, 1:], index[:-1, 1:]], dim=-1).reshape(-1, 3)
    vertices = torch.tensor([[0.0, 0, 0], [8, 0, 0], [0, 8, 0]], dtype=torch.float64)
    subdivision = subdivide(vertices, torch.tensor([[0, 1, 2]]), spaced(4.0)[:1]).replace(
        points=torch.stack([x, y, 0 * x], dim=-1).reshape(-1, 3),
        facet=torch.zeros(800, dtype=torch.long),
        barycentric=torch.tensor([0.5, 0.5, 0.0]).double().expand(800, 3),
        faces=torch.cat([low, up]),
        face_facet=torch.zeros(2 * len(low), dtype=torch.long),
    )
    z = torch.cos(2 * torch.pi * x / (wave * spacing))
    union = torch.stack([0 * z, 0 * z, z], dim=-1).reshape(-1, 3)
    everywhere = torch.ones(800, dtype=torch.bool)
    found = smooth_seams(subdivision, union, everywhere, spaced(spacing)[:1], radius)[:, 2]
    found, z = found.reshape(160, 5)[32:128], z[32:128]
    fraction = float((found * z).sum() / z.square().sum())
    wanted = 1 / (1 + (2 * torch.pi * radius / wave) ** 2)
    assert fraction == pytest.approx(wanted, abs=0.01)  # finite elements
