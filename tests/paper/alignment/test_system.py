import torch
from torch.testing import assert_close

from pimper_torch.paper.seams import (
    Pulls,
    curvature_along,
    find_seams,
    meet_overlaps,
    mismatches,
    scatter_blocks,
    seam_stiffness,
    solve_transforms,
)

IDENTITY = torch.tensor([0.0, 0, 1, 0], dtype=torch.float64)


def random_pulls(generator, prior):
    def random(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    normals = torch.nn.functional.normalize(random(3, 2, 3), dim=-1)
    return Pulls(
        facets=torch.tensor([[0, 1], [2, 1], [0, 2]]),
        normals=normals,
        samples=random(3, 2, 5, 4),
        gap=random(3, 5, 3),
        weight=random(3, 5).abs(),
        curvature=random(3, 2).abs(),
        corners=random(4, 3, 4),
        corner_weight=random(4, 3).abs(),
        prior_weight=torch.tensor(prior, dtype=torch.float64),
    )


def cost(pulls, transforms, stiffness):
    """The energy as the docstring writes it."""
    apart = mismatches(pulls, transforms).square().sum(dim=-1)
    seams = (stiffness * (pulls.weight * apart).sum(dim=1)).sum()
    height = (pulls.corners * transforms[:, None]).sum(dim=-1)
    free = pulls.prior_weight.isfinite()
    prior = (pulls.prior_weight * (transforms - IDENTITY).square())[:, free].sum()
    return seams + (pulls.corner_weight * height.square()).sum() + prior


def test_the_sparse_solution_is_where_the_energys_gradient_vanishes(generator):
    pulls = random_pulls(generator, [0.1, 0.2, 0.3, 0.4])
    stiffness = torch.tensor([1.0, 2.0, 0.5], dtype=torch.float64)
    start = IDENTITY.expand(4, 4)
    none = torch.zeros(3, 2, dtype=torch.float64)
    found = solve_transforms(pulls, start, stiffness, none).requires_grad_()
    (gradient,) = torch.autograd.grad(cost(pulls, found, stiffness), found)
    assert_close(gradient, torch.zeros_like(gradient), atol=1e-10, rtol=0)


def test_components_held_keep_their_values_and_the_others_answer_to_them(generator):
    pulls = random_pulls(generator, [0.1, 0.2, torch.inf, 0.4])
    start = torch.randn(4, 4, generator=generator, dtype=torch.float64)
    stiffness = torch.ones(3, dtype=torch.float64)
    none = torch.zeros(3, 2, dtype=torch.float64)
    found = solve_transforms(pulls, start, stiffness, none)
    assert_close(found[:, 2], start[:, 2])
    found.requires_grad_()
    (gradient,) = torch.autograd.grad(cost(pulls, found, stiffness), found)
    gradient = gradient[:, [0, 1, 3]]
    assert_close(gradient, torch.zeros_like(gradient), atol=1e-10, rtol=0)


def test_uplift_is_minus_half_the_energys_derivative_through_k(generator):
    pulls = random_pulls(generator, [0.1, 0.2, 0.3, 0.4])
    scales = torch.rand(3, 2, generator=generator, dtype=torch.float64).requires_grad_()
    apart = torch.rand(3, generator=generator, dtype=torch.float64)
    stiffness = seam_stiffness(pulls.curvature, scales, floor=0.01)
    (derivative,) = torch.autograd.grad((stiffness * apart).sum(), scales)
    uplift = (stiffness.square() * apart)[:, None] * pulls.curvature * scales
    assert_close(uplift, -derivative / 2)


def test_curvature_of_an_arc_is_that_of_its_parabola_and_has_no_unit():
    columns, length = 12, 3.0
    along = (torch.arange(columns, dtype=torch.float64) + 0.5) / columns
    arc = 4 * 0.1 * length * along * (1 - along) + 5 * along  # tenth of the edge, and a tilt
    heights = arc.expand(1, 2, 4, columns) * torch.tensor([1.0, 0.5])[:, None, None]
    met = torch.ones(1, 4, columns, dtype=torch.bool)
    met[0, 0, :5] = False
    heights = torch.where(met[:, None], heights, 99.0)
    found = curvature_along(heights, met, torch.tensor([length], dtype=torch.float64))
    assert_close(found, torch.tensor([[0.64, 0.16]], dtype=torch.float64))


def test_curvature_is_zero_where_too_little_is_met():
    heights = torch.randn(1, 2, 3, 12, dtype=torch.float64)
    met = torch.zeros(1, 3, 12, dtype=torch.bool)
    found = curvature_along(heights, met, torch.ones(1, dtype=torch.float64))
    assert_close(found, torch.zeros(1, 2, dtype=torch.float64))


def test_seams_name_each_inner_edge_once_with_rays_about_it(facets_over):
    patches = facets_over(lambda x, y: 0.2 * x * x - 0.1 * y * x)
    seams = find_seams(patches, rows=3, columns=4, reach_samples=5.0)
    mesh = patches.coarse.mesh
    faces = {frozenset(face.tolist()) for face in mesh.faces}
    assert len(seams.facets) == (3 * len(faces) - 16) // 2  # 16 edges on the silhouette
    for seam, (a, b) in enumerate(seams.facets.tolist()):
        shared = sorted(set(mesh.faces[a].tolist()) & set(mesh.faces[b].tolist()))
        start, end = mesh.vertices_world[shared]
        centre = seams.origins[seam].mean(dim=(0, 1))
        assert_close(centre, (start + end) / 2)
        assert_close(seams.edge_lengths[seam], (end - start).norm())
        assert seams.seam_of.flatten()[seams.place_of[seam]].tolist() == [seam, seam]
        assert (seams.place_of[seam] // 3).tolist() == [a, b]
    spread = (seams.origins[:, 2] - seams.origins[:, 0]).norm(dim=-1)
    assert_close(spread, torch.full_like(spread, 10 * float(patches.buckets[0].spacing[0])))


def test_two_height_fields_of_one_sphere_are_met_in_the_same_points(
    facets_over, height_fields, sphere_height_field
):
    center = torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64)
    patches = facets_over(lambda x, y: 2 - (4 - x**2 - y**2).sqrt())
    depths = height_fields(patches, sphere_height_field(center, 2.0))
    seams = find_seams(patches, rows=5, columns=8, reach_samples=4.0)
    identity = IDENTITY.expand(patches.num_patches, 4)
    overlaps = meet_overlaps(seams, patches, depths.buckets, identity)
    assert overlaps.met.float().mean() > 0.8
    lift = overlaps.samples[..., 2:] * seams.normals[:, :, None, None]
    points = overlaps.feet + lift
    apart = (points[:, 0] - points[:, 1]).norm(dim=-1)[overlaps.met]
    from_center = (points - center).norm(dim=-1)[overlaps.met[:, None].expand(-1, 2, -1, -1)]
    # Bilinear samples 0.02 apart on a curvature of 0.5: h^2/8 times twice that.
    assert apart.max() < 2e-4
    assert_close(from_center, torch.full_like(from_center, 2.0), atol=1e-4, rtol=0)


def test_blocks_land_where_kronecker_puts_them(generator):
    blocks = torch.randn(3, 2, 2, generator=generator, dtype=torch.float64)
    rows, cols, values = scatter_blocks(torch.tensor([0, 2, 2]), torch.tensor([1, 0, 0]), blocks)
    expected = torch.zeros(6, 6, dtype=torch.float64)
    expected[0:2, 2:4] = blocks[0]
    expected[4:6, 0:2] = blocks[1] + blocks[2]
    dense = torch.zeros(6, 6, dtype=torch.float64)
    assert_close(dense.index_put((rows, cols), values, accumulate=True), expected)
