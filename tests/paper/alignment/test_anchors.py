import pytest
import torch
from torch.testing import assert_close

from pimper_torch.paper.align import anchor_certainty, vertex_anchors


def bumps(x, y):
    return 0.03 * torch.sin(5 * x + 1) * torch.cos(4 * y)


def along_z(height, scale=1.0, offset=0.0):
    """The height field of coplanar facets in z = 0, whose patch frames have the world's z."""

    def height_field(points, patch_from_world):
        world = (points - patch_from_world[:, None, None, :3, 3]) @ patch_from_world[
            :, None, :3, :3
        ]
        return scale * height(world[..., 0], world[..., 1]) + offset

    return height_field


@pytest.fixture
def flat(facets_over):
    return facets_over(lambda x, y: 0 * x)


def test_certainty_is_one_over_the_variance_next_to_the_seams_noise():
    variance = torch.tensor([0.0, 0.01, 0.04, 1e6])
    found = anchor_certainty(variance, torch.tensor(0.1))
    assert_close(found, torch.tensor([1.0, 0.5, 0.2, 0.0]), atol=1e-7, rtol=1e-6)


def test_anchors_know_the_height_field_over_them_and_their_spread_along_the_normal(
    flat, height_fields
):
    depths = height_fields(flat, along_z(bumps, offset=0.2))
    coarse, count = flat.coarse, len(flat.coarse.mesh.vertices_world)
    long = torch.diag(torch.tensor([1.0, 1.0, 9.0], dtype=torch.float64))
    patches = flat.replace(coarse=coarse.replace(covariance_world=long.expand(count, 3, 3)))
    found = vertex_anchors(patches, depths.buckets)
    assert found.known.all()
    assert_close(found.variance, torch.full_like(found.variance, 9.0))
    x, y, _ = coarse.mesh.vertices_world[coarse.mesh.faces].unbind(dim=-1)
    assert_close(found.samples[..., 2], bumps(x, y) + 0.2, atol=2e-4, rtol=0)
    assert (vertex_anchors(flat, depths.buckets).variance == 0).all()
