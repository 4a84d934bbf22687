import pytest
import torch
from torch.testing import assert_close

from pimper_torch.paper.alignment.align import Align, AlignConfig
from pimper_torch.paper.alignment.anchors import anchor_certainty, point_anchors, vertex_anchors
from pimper_torch.records import FacetPoints


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


def with_points(depths, height, generator, per_facet=6, spread=1e-4, outliers=0.0):
    """Put points of a surface z(x, y) on flat facets."""
    mesh = depths.patches.coarse.mesh
    facet = torch.arange(len(mesh.faces)).repeat_interleave(per_facet)
    inner = torch.rand(len(facet), 3, generator=generator, dtype=torch.float64) + 0.2
    inner = inner / inner.sum(dim=1, keepdim=True)
    points = (inner[..., None] * mesh.vertices_world[mesh.faces[facet]]).sum(dim=1)
    points[:, 2] = height(points[:, 0], points[:, 1])
    wild = torch.rand(len(points), generator=generator) < outliers
    points[:, 2] += 0.5 * wild
    covariance = spread**2 * torch.eye(3, dtype=torch.float64).expand(len(points), 3, 3)
    cloud = FacetPoints(points_world=points, covariance_world=covariance, facet=facet)
    return with_coarse(depths, points=cloud)


def with_coarse(depths, **changes):
    patches = depths.patches
    coarse = patches.coarse.replace(**changes)
    return depths.replace(
        photometric=depths.photometric.replace(patches=patches.replace(coarse=coarse))
    )


def by_facet(depths):
    facets = torch.cat([templates.facet for templates in depths.patches.buckets])
    return torch.cat([height_field.transform for height_field in depths.buckets])[
        torch.argsort(facets)
    ]


def mean_height(depths):
    return float(
        torch.cat(
            [height_field.depth[height_field.valid] for height_field in depths.buckets]
        ).mean()
    )


@pytest.fixture
def flat(facets_over):
    return facets_over(lambda x, y: 0 * x)


def test_certainty_is_one_over_the_variance_next_to_the_seams_noise():
    variance = torch.tensor([0.0, 0.01, 0.04, 1e6])
    found = anchor_certainty(variance, torch.tensor(0.1))
    assert_close(found, torch.tensor([1.0, 0.5, 0.2, 0.0]), atol=1e-7, rtol=1e-6)


def test_anchors_know_the_height_field_over_them_and_their_spread_along_the_normal(
    flat, height_fields, generator
):
    depths = with_points(height_fields(flat, along_z(bumps, offset=0.2)), bumps, generator)
    long = torch.diag(torch.tensor([1.0, 1.0, 9.0], dtype=torch.float64))
    cloud = depths.patches.coarse.points
    cloud = cloud.replace(covariance_world=long.expand(len(cloud.facet), 3, 3))
    depths = with_coarse(depths, points=cloud)
    found = point_anchors(depths.patches, depths.buckets)
    assert found.known.all()
    assert (found.facet == cloud.facet).all()
    assert_close(found.variance, torch.full_like(found.variance, 9.0))
    assert_close(found.samples[:, 2], cloud.points_world[:, 2] + 0.2, atol=2e-4, rtol=0)
    assert_close(found.heights, cloud.points_world[:, 2])
    corners = vertex_anchors(depths.patches, depths.buckets)
    assert corners.facet.tolist() == [f for f in range(depths.patches.num_patches) for _ in "abc"]
    assert_close(corners.heights, torch.zeros_like(corners.heights), atol=1e-12, rtol=0)
    assert (corners.variance == 0).all()


def test_the_common_scale_of_coplanar_facets_is_told_by_points_only(flat, height_fields, generator):
    halved = height_fields(flat, along_z(bumps, scale=0.5))
    without = by_facet(Align(AlignConfig(anchor=0.0))(halved))
    assert_close(without[:, 2], torch.ones(len(without)).double(), atol=1e-3, rtol=0)
    hearing = Align(AlignConfig(anchor=0.0, prior=1e-6))
    told = by_facet(hearing(with_points(halved, bumps, generator)))
    assert_close(told[:, 2], 2 * torch.ones(len(told)).double(), atol=0.1, rtol=0)
    deaf = Align(AlignConfig(anchor=0.0, points=0.0))
    assert_close(by_facet(deaf(with_points(halved, bumps, generator))), without)


def test_of_points_and_vertices_the_certain_ones_decide(flat, height_fields, generator):
    lifted = height_fields(flat, along_z(bumps, offset=0.1))

    def offset(spread, vertex_spread):
        depths = with_points(
            lifted, lambda x, y: bumps(x, y) + 0.1, generator, per_facet=1, spread=spread
        )
        count = len(depths.patches.coarse.mesh.vertices_world)
        eye = torch.eye(3, dtype=torch.float64).expand(count, 3, 3)
        sure = with_coarse(depths, covariance_world=vertex_spread**2 * eye)
        return mean_height(Align()(sure))

    assert abs(offset(1e-4, 1.0) - 0.1) < 0.01  # stays where the points are
    assert abs(offset(1.0, 1e-4)) < 0.01  # goes down to the vertices


def test_a_point_far_off_is_not_followed(flat, height_fields, generator):
    exact = height_fields(flat, along_z(bumps))
    some = with_points(exact, bumps, generator, outliers=0.1)
    away = some.patches.coarse.points.points_world[:, 2].abs() > 0.2
    assert 5 < away.sum() < 0.2 * len(away)
    spoiled = by_facet(Align(AlignConfig(anchor=0.0, outlier=1e6))(some))
    found = by_facet(Align(AlignConfig(anchor=0.0))(some))
    identity = torch.tensor([0.0, 0, 1, 0], dtype=torch.float64)
    assert (found - identity)[:, 3].abs().mean() < 0.05 * (spoiled - identity)[:, 3].abs().mean()


def test_a_mesh_from_elsewhere_needs_no_cloud(flat, height_fields):
    depths = height_fields(flat, along_z(bumps, offset=0.1))
    assert depths.patches.coarse.points is None
    assert depths.patches.coarse.covariance_world is None
    assert abs(mean_height(Align()(depths))) < 0.01
