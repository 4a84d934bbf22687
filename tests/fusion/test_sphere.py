"""Fusion on a spherical cap of 24 facets, against its closed form and draws of noise."""

import math

import pytest
import torch
from scipy.spatial import Delaunay
from torch.nn.functional import normalize

import pimper_torch as pt
from pimper_torch.geometry.pinholes import pinholes
from pimper_torch.geometry.rigid import invert_rigid, rotate, transform
from pimper_torch.geometry.surfaces import face_normals, vertex_normals
from pimper_torch.geometry.template_normals import transferred_normals
from pimper_torch.records import Heights
from pimper_torch.stages.fusion.blend import vertex_spacing
from pimper_torch.stages.fusion.detail import spacing_of
from pimper_torch.stages.fusion.estimate import fuse_terms
from pimper_torch.stages.fusion.fuse_config import FuseConfig
from pimper_torch.stages.fusion.problem import fusion_problem, subdivide_facets
from pimper_torch.stages.fusion.terms import KeptSlopes, Normals, SweptHeights
from pimper_torch.stages.patches.patches_config import DecomposeConfig
from tests.fusion.test_fuse import unlit
from tests.threads import on_threads

# Center of the sphere of radius 1, which is seen from -z.
CENTER = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
SPACING = 0.03


def off_sphere(points):
    return (points - CENTER).norm(dim=-1) - 1


def cameras():
    cam_from_world = torch.eye(4, dtype=torch.float64)[None].clone()
    cam_from_world[0, 2, 3] = 4
    return pinholes(cam_from_world, 4 / SPACING, 100, 100)


def free():
    views = torch.ones(1, 1, 1)
    nothing = torch.zeros(1, dtype=torch.bool)
    silhouettes = pt.Silhouettes(inside=views, reliable=nothing, source="everything")
    return pt.Contours.none(silhouettes, cameras())


@pytest.fixture(scope="module")
def cap():
    return cap_of(2)


@pytest.fixture(scope="module")
def wide():
    """Facets of 38 samples a side."""
    return cap_of(1, samples_per_pixel=2.0)


def cap_of(count, samples_per_pixel=1.0):
    """Return rings of facets inscribed in the sphere, with exact normals and heights."""
    rings = [torch.zeros(1, 2, dtype=torch.float64)]
    for ring in range(1, count + 1):
        angle = torch.arange(6 * ring) * (math.tau / (6 * ring)) + 0.3
        rings.append(0.6 / count * ring * torch.stack([angle.cos(), angle.sin()], dim=1).double())
    xy = torch.cat(rings)
    vertices = torch.cat([xy, 1 - (1 - xy.square().sum(dim=1, keepdim=True)).sqrt()], dim=1)
    faces = torch.tensor(Delaunay(xy.numpy()).simplices).long()
    faces = torch.where((face_normals(vertices, faces)[:, 2] > 0)[:, None], faces.flip(1), faces)
    mesh = pt.Mesh(
        vertices_world=vertices, faces=faces, normals_world=vertex_normals(vertices, faces)
    )
    coarse = pt.CoarseMesh(mesh=mesh, reference=0, is_point=torch.ones(len(xy), dtype=torch.bool))
    config = DecomposeConfig(overlap_samples=3.0, samples_per_pixel=samples_per_pixel)
    patches = pt.Decompose(config)(coarse, cameras())
    normals, heights = zip(
        *(exact(coarse, templates) for templates in patches.buckets), strict=True
    )
    photometric = pt.PhotometricPatches.of(
        patches, normals=normals, lights=torch.ones(1, 4), information=1e4
    )
    return pt.SweptPatches(photometric=photometric, buckets=heights, averaged=1.0)


def exact(coarse, templates):
    """Return the normals and heights where rays from the flat templates meet the sphere."""
    world_from_patch = invert_rigid(templates.patch_from_world)
    start = transform(world_from_patch, templates.points_patch.flatten(1, 2)) - CENTER
    along = rotate(world_from_patch, transferred_normals(coarse, templates).flatten(1, 2))
    middle = (start * along).sum(dim=-1)
    distance = -middle + (middle.square() - start.square().sum(dim=-1) + 1).sqrt()
    outward = start + distance[..., None] * along
    shape = templates.depth.shape
    normals = rotate(templates.patch_from_world, outward).reshape(*shape, 3)
    return normals, Heights(
        offset=distance.reshape(shape) * templates.inside,
        information=templates.inside / (0.2 * SPACING) ** 2,
        num_views=torch.full_like(templates.facet, 8),
    )


def noisy(cap, rotation, lift, generator):
    """Add noise to normals, in radians per axis, and to heights, in samples.

    Stated standard deviations are a quarter of the noise.
    """

    def drawn(like):
        return torch.randn(like.shape, generator=generator, dtype=torch.float64)

    photometry = tuple(
        found.replace(
            normals_patch=normalize(
                found.normals_patch + rotation * drawn(found.normals_patch), dim=-1
            ),
            information=16 * found.valid / (2 * rotation**2),
        )
        for found in cap.photometric.buckets
    )
    heights = tuple(
        found.replace(
            offset=found.offset + lift * SPACING * drawn(found.offset),
            information=16 * (found.information > 0) / (lift * SPACING) ** 2,
        )
        for found in cap.buckets
    )
    return cap.replace(photometric=cap.photometric.replace(buckets=photometry), buckets=heights)


def rippled(cap, period, **sizes):
    """Add waves, period in samples, to albedo, normals or heights of one facet."""
    photometry, heights = list(cap.photometric.buckets), list(cap.buckets)
    first = torch.arange(len(photometry[0].albedo)) == 0
    columns = torch.arange(photometry[0].albedo.shape[2])
    wave = first[:, None, None] * (columns * math.tau / period).sin().double()
    found = photometry[0]
    across = found.normals_patch.new_tensor([sizes.get("normals", 0.0), 0, 0])
    photometry[0] = found.replace(
        albedo=found.albedo * (1 + sizes.get("albedo", 0.0) * wave[..., None]),
        normals_patch=normalize(found.normals_patch + across * wave[..., None], dim=-1),
    )
    offset = heights[0].offset + sizes.get("heights", 0.0) * wave
    heights[0] = heights[0].replace(offset=offset)
    photometric = cap.photometric.replace(buckets=tuple(photometry))
    return cap.replace(photometric=photometric, buckets=tuple(heights))


@pytest.mark.parametrize(
    ("period", "sizes", "apart"),
    [
        (4, {}, 4),
        (4, {"normals": 0.02}, 1),  # twice the stated error
        (4, {"normals": 0.002}, 4),
        (16, {"normals": 0.04}, 2),
        (4, {"heights": 0.2 * SPACING}, 1),
        (4, {"heights": 0.02 * SPACING}, 4),
        (4, {"albedo": 0.2}, 1),
        (4, {"albedo": 0.02}, 4),
    ],
)
def test_vertex_spacing_follows_the_detail_of_each_facet(wide, period, sizes, apart):
    swept = rippled(wide, period, **sizes)
    finest = vertex_spacing(swept.patches, 1.0)
    expected = torch.full_like(finest, 4.0)
    expected[swept.patches.buckets[0].facet[0]] = apart
    assert torch.equal(spacing_of(swept, 1.0, 0.15) / finest, expected)
    assert torch.equal(spacing_of(swept, 0.5, 0.0), 0.5 * finest)


def test_a_ripple_is_kept_while_other_facets_are_coarse(wide):
    """Its slopes are photometric: heights have the wave's amplitude over its wave number."""
    swept = rippled(wide, 8, normals=0.2)
    some, every = (pt.Fuse(FuseConfig(max_lost=lost))(swept, free()) for lost in (0.1, 0.0))
    assert 3 * len(some.vertices_world) < len(every.vertices_world)
    facet = swept.patches.buckets[0].facet[0]
    inner = (some.facet == facet) & (some.barycentric > 0.2).all(dim=1)
    same = (every.facet == facet) & (every.barycentric > 0.2).all(dim=1)
    assert torch.equal(some.barycentric[inner], every.barycentric[same])
    apart = (some.vertices_world[inner] - every.vertices_world[same]).norm(dim=1)
    assert apart.max() < 0.02 * SPACING
    assert off_sphere(some.vertices_world[inner]).std() > 0.05 * SPACING


def test_flat_facets_are_moved_onto_the_sphere(cap):
    surface = pt.Fuse(FuseConfig(max_lost=0.0))(cap, free())
    mesh = cap.patches.coarse.mesh
    sag = off_sphere(mesh.vertices_world[mesh.faces].mean(dim=1)).abs().max()
    assert sag > 0.7 * SPACING
    off = off_sphere(surface.vertices_world).abs()
    assert off.median() < 0.02 * SPACING  # bilinear cells sag by SPACING^2 / 4: 0.008
    assert off.max() < 0.04 * SPACING
    radial = normalize(surface.vertices_world - CENTER, dim=-1)
    angle = (surface.normals_world * radial).sum(dim=-1).clamp(-1, 1).acos().rad2deg()
    assert angle.quantile(0.9) < 0.5  # those of facets are off by up to 8
    assert angle.max() < 2  # at the border, where one side is missing


@pytest.mark.parametrize(("rotation", "lift"), [(0.05, 0.5), (0.2, 2.0)])
def test_the_expected_error_matches_draws_despite_wrong_variances(cap, rotation, lift):
    # Facets share no error, so the normal bias would be chance and is not estimated.
    fuse = pt.Fuse(FuseConfig(bias_iterations=0))
    generator = torch.Generator().manual_seed(7)
    true, expected = [], []
    for _ in range(8):
        surface = fuse(noisy(cap, rotation, lift, generator), free())
        true.append(off_sphere(surface.vertices_world).square().mean())
        expected.append(surface.expected_error.square().mean())
    ratio = (torch.stack(true).mean() / torch.stack(expected).mean()).sqrt()
    # Measured 0.81 and 1.18; eight draws of eight draws. Slopes of neighbouring edges share
    # the error of a normal, but errors are drawn per edge: with normals alone it is 1.5.
    assert 0.75 < ratio < 1.25


def test_heights_without_photometric_normals_have_their_own_noise_factor(cap):
    wild = noisy(cap, 0.0, 1.0, torch.Generator().manual_seed(8)).buckets
    photometry, heights = [], []
    for templates, found, exact_ones, drawn in zip(
        cap.patches.buckets, cap.photometric.buckets, cap.buckets, wild, strict=True
    ):
        centre = invert_rigid(templates.patch_from_world)[:, :3, 3]
        lit = (centre[:, 0] > 0)[:, None, None]
        photometry.append(
            found.replace(valid=found.valid & lit, information=lit * found.information)
        )
        heights.append(exact_ones.replace(offset=torch.where(lit, exact_ones.offset, drawn.offset)))
    swept = cap.replace(
        photometric=cap.photometric.replace(buckets=tuple(photometry)), buckets=tuple(heights)
    )
    problem = fusion_problem(
        swept, subdivide_facets(swept, vertex_spacing(swept.patches, 1.0)), True
    )
    own, coarse = kinds = SweptHeights().equations(problem)
    assert not torch.isin(own.unknowns, coarse.unknowns).any()
    kinds += [*Normals().equations(problem), *KeptSlopes().equations(problem)]
    fused = fuse_terms(kinds, problem.blend.heights, problem.damping, 4)
    # All heights state a fifth of a spacing: some are exact, others are off by one spacing.
    assert fused.factors[0] < 0.5
    assert fused.factors[1] > 5


def test_a_large_surface_is_bitwise_equal_on_any_number_of_threads(cap):
    """Torch splits sums of more than 32,768 numbers among threads."""
    claimed = noisy(cap, 0.05, 0.3, torch.Generator().manual_seed(5))
    fuse = pt.Fuse(
        FuseConfig(samples_per_vertex=0.25, bias_iterations=1, noise_iterations=1, error_draws=0)
    )
    one, two = on_threads(lambda: fuse(claimed, free()), 1, 2)
    assert len(one.faces) > 32_768
    assert torch.equal(one.vertices_world, two.vertices_world)
    assert torch.equal(one.convergence.residual, two.convergence.residual)


def test_heights_alone_bend_flat_facets_to_the_sphere(cap):
    swept = noisy(cap, 0.0, 0.2, torch.Generator().manual_seed(7))
    surface = pt.Fuse()(unlit(swept.replace(photometric=cap.photometric)), free())
    assert (surface.information == 0).all()
    assert surface.supported.double().mean() > 0.95
    off = off_sphere(surface.vertices_world).abs()
    assert off.median() < 0.06 * SPACING  # facets sag by 0.7; measured 0.042
