import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_torch.geometry.rigid import invert_rigid, rigid
from pimper_torch.paper.align import Align, patch_status, vertex_anchors
from pimper_torch.paper.paper_config import AlignConfig
from pimper_torch.paper.seams import (
    AlignTerms,
    curvature_along,
    find_seams,
    intersect_overlaps,
    seam_stiffness,
    solve_transforms,
)
from pimper_torch.records import AlignStatus
from tests.published.scenes import (
    IDENTITY,
    ball,
    by_facet,
    changed,
    facets_over,
    grid,
    height_fields,
    level,
    random_transforms,
    spoiled,
    waves,
)

ALIGNED, ALONE = (int(status) for status in AlignStatus)


def error(found, truth):
    pairs = zip(found.buckets, truth.buckets, strict=True)
    apart = torch.cat([(a.depth - b.depth)[a.valid & b.valid] for a, b in pairs])
    return float(apart.square().mean().sqrt())


def statuses(depths):
    return torch.cat([height_field.status for height_field in depths.buckets])


def along_world_z(height):
    """Return height fields on coplanar facets with patch frames along the world's z."""

    def height_field(points, patch_from_world):
        away = points - patch_from_world[:, None, None, :3, 3]
        x, y, _ = (away @ patch_from_world[:, None, :3, :3]).unbind(dim=-1)
        return height(x, y)

    return height_field


def bumps(x, y):
    return 0.03 * torch.sin(5 * x + 1) * torch.cos(4 * y)


@pytest.mark.parametrize(("prior", "left"), [(1e-6, 0.001), (3e-4, 0.03)])
def test_alignment_inverts_random_bas_relief_transforms(sphere, generator, prior, left):
    put_on = random_transforms(sphere.patches.num_patches, generator)
    bad = spoiled(sphere, put_on)
    found = Align(AlignConfig(prior=prior, iterations=4))(bad)
    assert error(found, sphere) < left * error(bad, sphere)
    # Scales as well: anchors do not determine them, but neighbours and folds do.
    scales = by_facet(found)[:, 2] * put_on[:, 2]
    assert (scales - 1).abs().mean() < 2 * left
    assert (by_facet(found)[:, 3] == 0).all()  # patches do not move along their normals
    assert found.mismatch.shape == (5,)
    assert found.mismatch[-1] < 0.02 * found.mismatch[0]


def test_depths_are_transformed_as_reported(sphere, generator):
    bad = spoiled(sphere, random_transforms(sphere.patches.num_patches, generator))
    once = Align()(bad)
    assert error(spoiled(bad, by_facet(once)), once) < 1e-12
    twice = Align()(once)
    assert error(spoiled(bad, by_facet(twice)), twice) < 1e-12


@pytest.mark.parametrize(("noise", "least"), [(0.0, 0.995), (0.002, 0.97), (0.005, 0.9)])
def test_scales_do_not_shrink_after_random_transforms_and_noise(sphere, generator, noise, least):
    """Noise is up to a quarter of the root mean square of the height field."""
    put_on = random_transforms(sphere.patches.num_patches, generator)
    bad = waves(spoiled(sphere, put_on), noise, generator)
    found = Align(AlignConfig(prior=1e-6, iterations=4))(bad)
    scales = by_facet(found)[:, 2] * put_on[:, 2]
    assert least < scales.median() < 1.05
    assert scales.min() > 0.3


def test_coplanar_facets_are_not_flattened(flat, generator):
    """All seams also agree at h = 0: only the gauge excludes it."""
    fields = height_fields(flat, along_world_z(bumps))
    put_on = random_transforms(flat.num_patches, generator)
    config = AlignConfig(prior=1e-5, anchor=0.0, iterations=4)
    scales = by_facet(Align(config)(spoiled(fields, put_on)))[:, 2] * put_on[:, 2]
    assert scales.mean() > 0.5
    noise = by_facet(Align()(waves(height_fields(flat, level), 0.02, generator)))[:, 2]
    assert 0.25 <= noise.min() <= noise.max() <= 4


def test_alignment_is_invariant_to_similarities_of_the_world(sphere, generator):
    bad = spoiled(sphere, random_transforms(sphere.patches.num_patches, generator))
    q, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    q = q * torch.linalg.det(q)
    size, shift = 7.0, torch.tensor([30.0, -4.0, 9.0], dtype=torch.float64)
    old_from_new = invert_rigid(rigid(q, shift))
    coarse = bad.patches.coarse
    vertices = size * coarse.mesh.vertices_world @ q.T + shift
    templates = []
    for bucket in bad.patches.buckets:
        grown = bucket.patch_from_world.clone()
        grown[:, :3, 3] *= size
        grown = grown @ old_from_new
        origin, spacing = size * bucket.origin, size * bucket.spacing
        templates.append(bucket.replace(patch_from_world=grown, origin=origin, spacing=spacing))
    patches = bad.patches.replace(
        coarse=coarse.replace(mesh=coarse.mesh.replace(vertices_world=vertices)),
        buckets=tuple(templates),
    )
    moved = bad.replace(photometric=bad.photometric.replace(patches=patches))
    moved = changed(moved, lambda _, field: {"depth": size * field.depth})
    here, there = Align()(bad), Align()(moved)
    for a, b in zip(here.buckets, there.buckets, strict=True):
        assert_close(b.depth, size * a.depth, atol=1e-7, rtol=1e-7)
    assert_close(there.mismatch, size * here.mismatch)


def test_a_patch_without_data_is_unchanged_and_does_not_affect_others(sphere, generator):
    bad = spoiled(sphere, random_transforms(sphere.patches.num_patches, generator))

    def blinded(templates, field):
        first = (templates.facet == bad.patches.buckets[0].facet[0])[:, None, None]
        depth = torch.where(first, torch.nan, field.depth)
        return {"depth": depth, "valid": field.valid & ~first}

    found = Align(AlignConfig(prior=1e-5))(changed(bad, blinded))
    assert statuses(found).tolist() == [ALONE] + [ALIGNED] * (sphere.patches.num_patches - 1)
    assert_close(found.buckets[0].transform[0], IDENTITY)
    assert error(found, sphere) < 0.002


def test_patches_without_overlap_are_returned_unchanged(sphere):
    alone = changed(sphere, lambda _, field: {"valid": field.valid & False})
    assert Align()(alone) is alone
    corner = torch.tensor([[0.0, 0], [1, 0], [0, 1]], dtype=torch.float64)
    facet = height_fields(facets_over(lambda x, y: 0 * x, corner), level)
    assert Align()(facet) is facet


def test_the_status_records_alignment(sphere):
    assert all(height_field.status is None for height_field in sphere.buckets)
    assert not any(height_field.aligned.any() for height_field in sphere.buckets)
    found = Align()(sphere)
    assert (statuses(found) == ALIGNED).all()
    assert all(height_field.aligned.all() for height_field in found.buckets)
    assert "aligned_patches" not in sphere.figures()
    assert found.figures()["aligned_patches"] == found.patches.num_patches
    assert found.figures()["mismatch"] == float(found.mismatch[-1])


def test_a_patch_without_heights_at_its_border_is_alone(generator):
    height, height_field = ball(2.0)
    patches = facets_over(height, grid(generator, side=4))
    lone = patches.buckets[0].facet[0]

    def islet(templates, field):
        centre = (templates.barycentric > 0.25).all(dim=-1)
        return {"valid": field.valid & (centre | (templates.facet != lone)[:, None, None])}

    found = statuses(Align()(changed(height_fields(patches, height_field), islet)))
    assert found[0] == ALONE
    # A facet in a corner of the mesh has no other neighbour.
    assert (found == ALONE).sum() <= 2


def test_a_patch_is_aligned_if_enough_of_a_seam_overlaps():
    met = torch.ones(3, 8, dtype=torch.bool)
    met[1, 1:] = False  # hardly any overlap
    facets = torch.tensor([[0, 1], [2, 3], [1, 4]])
    assert patch_status(facets, met, 6).tolist() == [ALIGNED, ALIGNED, ALONE, ALONE, ALIGNED, ALONE]


def test_anchors_have_heights_and_variances_along_the_normal(flat):
    depths = height_fields(flat, along_world_z(lambda x, y: bumps(x, y) + 0.2))
    coarse, count = flat.coarse, len(flat.coarse.mesh.vertices_world)
    long = torch.diag(torch.tensor([1.0, 1.0, 9.0], dtype=torch.float64))
    patches = flat.replace(coarse=coarse.replace(covariance_world=long.expand(count, 3, 3)))
    found = vertex_anchors(patches, depths.buckets)
    assert found.valid.all()
    assert_close(found.variance, torch.full_like(found.variance, 9.0))
    x, y, _ = coarse.mesh.vertices_world[coarse.mesh.faces].unbind(dim=-1)
    assert_close(found.samples[..., 2], bumps(x, y) + 0.2, atol=2e-4, rtol=0)
    assert (vertex_anchors(flat, depths.buckets).variance == 0).all()


@pytest.mark.parametrize("prior", [(0.1, 0.2, 0.3, 0.4), (0.1, 0.2, torch.inf, 0.4)])
def test_the_gradient_of_the_published_energy_vanishes_at_the_solution(generator, prior):
    """Components with an infinite prior are fixed; the others adapt to them."""

    def random(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    facets = torch.tensor([[0, 1], [2, 1], [0, 2]])
    terms = AlignTerms(
        facets=facets,
        normals=normalize(random(3, 2, 3), dim=-1),
        samples=random(3, 2, 5, 4),
        gap=random(3, 5, 3),
        weight=random(3, 5).abs(),
        curvature=random(3, 2).abs(),
        corners=random(4, 3, 4),
        corner_weight=random(4, 3).abs(),
        prior_weight=torch.tensor(prior, dtype=torch.float64),
    )
    start, k, none = random(4, 4), random(3).abs(), torch.zeros(3, 2).double()
    found = solve_transforms(terms, start, k, none).requires_grad_()
    free = terms.prior_weight.isfinite()
    assert_close(found[:, ~free], start[:, ~free])
    energy = (terms.prior_weight * (found - IDENTITY).square())[:, free].sum()
    energy += (terms.corner_weight * (terms.corners * found[:, None]).sum(-1).square()).sum()
    for seam in range(3):
        for ray in range(5):
            apart = terms.gap[seam, ray]
            for side, sign in ((0, 1), (1, -1)):
                height = found[facets[seam, side]] @ terms.samples[seam, side, ray]
                apart = apart + sign * height * terms.normals[seam, side]
            energy += k[seam] * terms.weight[seam, ray] * apart.square().sum()
    (gradient,) = torch.autograd.grad(energy, found)
    assert_close(gradient[:, free], 0 * gradient[:, free], atol=1e-10, rtol=0)


def test_uplift_is_minus_half_the_derivative_of_the_energy_by_k(generator):
    draw = torch.rand(3, 5, generator=generator, dtype=torch.float64)
    curvature, scales, apart = draw[:, :2], draw[:, 2:4].clone().requires_grad_(), draw[:, 4]
    stiffness, uplift = seam_stiffness(curvature, scales, apart)
    (derivative,) = torch.autograd.grad((stiffness * apart).sum(), scales)
    assert_close(uplift, -derivative / 2)


def test_curvature_of_a_parabolic_arc_is_dimensionless():
    columns, length = 12, 3.0
    along = (torch.arange(columns, dtype=torch.float64) + 0.5) / columns
    arc = 4 * 0.1 * length * along * (1 - along) + 5 * along  # a tenth of the edge, plus a tilt
    heights = arc.expand(1, 2, 4, columns) * torch.tensor([1.0, 0.5])[:, None, None]
    met = torch.ones(1, 4, columns, dtype=torch.bool)
    met[0, 0, :5] = False
    heights = torch.where(met[:, None], heights, 99.0)
    edge = torch.tensor([length], dtype=torch.float64)
    found = curvature_along(heights, met, edge)
    assert_close(found, torch.tensor([[0.64, 0.16]], dtype=torch.float64))
    assert (curvature_along(heights, met & False, edge) == 0).all()


def test_each_inner_edge_has_one_seam_with_rays_around_it(generator):
    patches = facets_over(lambda x, y: 0.2 * x * x - 0.1 * y * x, grid(generator))
    seams = find_seams(patches, rows=3, columns=4, reach_samples=5.0)
    mesh = patches.coarse.mesh
    assert len(seams.facets) == (3 * len(mesh.faces) - 16) // 2  # 16 edges on the silhouette
    for seam, (a, b) in enumerate(seams.facets.tolist()):
        shared = sorted(set(mesh.faces[a].tolist()) & set(mesh.faces[b].tolist()))
        start, end = mesh.vertices_world[shared]
        centre = seams.origins[seam].mean(dim=(0, 1))
        assert_close(centre, (start + end) / 2)
        assert_close(seams.edge_lengths[seam], (end - start).norm())
        assert seams.seam_of.flatten()[seams.slot_of[seam]].tolist() == [seam, seam]
        assert (seams.slot_of[seam] // 3).tolist() == [a, b]
    spread = (seams.origins[:, 2] - seams.origins[:, 0]).norm(dim=-1)
    assert_close(spread, torch.full_like(spread, 10 * float(patches.buckets[0].spacing[0])))


def test_overlapping_height_fields_of_a_sphere_meet_in_the_same_points(sphere):
    patches = sphere.patches
    seams = find_seams(patches, rows=5, columns=8, reach_samples=4.0)
    identity = IDENTITY.expand(patches.num_patches, 4)
    samples, feet, met = intersect_overlaps(seams, patches, sphere.buckets, identity)
    assert met.float().mean() > 0.8
    points = feet + samples[..., 2:] * seams.normals[:, :, None, None]
    apart = (points[:, 0] - points[:, 1]).norm(dim=-1)[met]
    from_center = (points - points.new_tensor([0, 0, 2])).norm(dim=-1)
    from_center = from_center[met[:, None].expand(-1, 2, -1, -1)]
    # Bilinear samples at a spacing h of 0.02 on a curvature of 0.5: h^2/8 times twice that.
    assert apart.max() < 2e-4
    assert_close(from_center, torch.full_like(from_center, 2.0), atol=1e-4, rtol=0)
