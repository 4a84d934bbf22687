"""The published system against a dense assembly, and what keeps it from flattening."""

import pytest
import torch
from torch.testing import assert_close

from pimper_torch.paper.align import Align
from pimper_torch.paper.paper_config import AlignConfig
from pimper_torch.paper.seams import Pulls, solve_transforms
from tests.paper.alignment.caps import by_facet, random_transforms, spoiled, waves


def test_three_numbers_a_patch_solve_the_dense_kronecker_equations(generator):
    """vec(N h^T S) = (S^T kron N) h, stacked for all seams and solved by least squares."""

    def random(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    facets = torch.tensor([[0, 1], [2, 1], [0, 2], [3, 2]])
    normals = torch.nn.functional.normalize(random(4, 2, 3), dim=-1)
    samples, feet = random(4, 2, 5, 4), random(4, 2, 5, 3)
    weight, k = random(4, 5).abs(), random(4).abs()
    corners, corner_weight = random(4, 3, 4), random(4, 3).abs()
    prior = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    pulls = Pulls(
        facets=facets,
        normals=normals,
        samples=samples,
        gap=feet[:, 0] - feet[:, 1],
        weight=weight,
        curvature=torch.zeros(4, 2, dtype=torch.float64),
        corners=corners,
        corner_weight=corner_weight,
        prior_weight=torch.cat([prior, prior.new_tensor([torch.inf])]),
    )
    start = prior.new_tensor([0, 0, 1, 0]).expand(4, 4)
    found = solve_transforms(pulls, start, k, torch.zeros(4, 2, dtype=torch.float64))

    rows, right = [], []
    for seam, (first, second) in enumerate(facets.tolist()):
        block = torch.zeros(15, 12, dtype=torch.float64)
        for side, (patch, sign) in enumerate(((first, 1), (second, -1))):
            normal = normals[seam, side, :, None]
            kronecker = [torch.kron(s[None, :3], normal) for s in samples[seam, side]]
            block[:, 3 * patch : 3 * patch + 3] += sign * torch.cat(kronecker)
        root = (k[seam] * weight[seam]).sqrt().repeat_interleave(3)
        rows.append(root[:, None] * block)
        right.append(root * (feet[seam, 1] - feet[seam, 0]).flatten())
    for patch in range(4):
        held = torch.zeros(3, 12, dtype=torch.float64)
        held[:, 3 * patch : 3 * patch + 3] = (
            corner_weight[patch].sqrt()[:, None] * corners[patch, :, :3]
        )
        rows += [
            held,
            torch.eye(12, dtype=torch.float64)[3 * patch : 3 * patch + 3] * prior.sqrt()[:, None],
        ]
        right += [torch.zeros(3).double(), prior.sqrt() * prior.new_tensor([0, 0, 1])]
    dense = torch.linalg.lstsq(torch.cat(rows), torch.cat(right)[:, None]).solution
    assert_close(found[:, :3], dense.reshape(4, 3), atol=1e-10, rtol=1e-9)
    assert (found[:, 3] == 0).all()


@pytest.mark.parametrize(("noise", "least"), [(0.0, 0.995), (0.002, 0.97), (0.005, 0.9)])
def test_scales_do_not_shrink_after_random_transforms_and_noise(sphere, generator, noise, least):
    """Noise is up to a quarter of the height field's own root mean square."""
    put_on = random_transforms(sphere.patches.num_patches, generator)
    bad = waves(spoiled(sphere, put_on), noise, generator)
    found = Align(AlignConfig(prior=1e-6, iterations=4))(bad)
    scales = by_facet(found)[:, 2] * put_on[:, 2]
    assert scales.median() > least
    assert scales.median() < 1.05
    assert scales.min() > 0.3


def test_flattening_costs_nothing_on_coplanar_facets_and_is_not_chosen(
    facets_over, height_fields, generator
):
    """All seams agree at h = 0 too: nothing but the gauge tells the two apart."""

    def bumps(points, patch_from_world):
        world = points - patch_from_world[:, None, None, :3, 3]
        world = world @ patch_from_world[:, None, :3, :3]
        return 0.03 * torch.sin(5 * world[..., 0]) * torch.cos(4 * world[..., 1])

    flat = height_fields(facets_over(lambda x, y: 0 * x), bumps)
    put_on = random_transforms(flat.patches.num_patches, generator)
    found = Align(AlignConfig(prior=1e-5, anchor=0.0, iterations=4))(spoiled(flat, put_on))
    scales = by_facet(found)[:, 2] * put_on[:, 2]
    assert scales.mean() > 0.5
