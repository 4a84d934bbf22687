import torch
from torch.testing import assert_close

from pimper_torch.paper.alignment.align import Align, AlignConfig
from pimper_torch.paper.alignment.anchors import vertex_anchors
from pimper_torch.paper.alignment.reliability import (
    judge_patches,
    overlapping_seams,
    reliable_seams,
)
from pimper_torch.records import AlignStatus
from pimper_torch.reporting import figures

RADIUS = 2.0
CENTER = torch.tensor([0.0, 0.0, RADIUS], dtype=torch.float64)
ALIGNED, ALONE, DISPUTED = (int(status) for status in AlignStatus)


def cap(x, y):
    return RADIUS - (RADIUS**2 - x**2 - y**2).sqrt()


def statuses(depths):
    return torch.cat([height_field.status for height_field in depths.buckets])


def with_first(depths, change):
    """Change the first patch of the first bucket."""
    first, *rest = depths.buckets
    return depths.replace(buckets=(change(first), *rest))


def test_before_alignment_nobody_is_aligned_and_after_it_all_are(
    facets_over, height_fields, sphere_height_field
):
    sphere = height_fields(facets_over(cap), sphere_height_field(CENTER, RADIUS))
    assert all(height_field.status is None for height_field in sphere.buckets)
    assert not any(height_field.aligned.any() for height_field in sphere.buckets)
    found = Align()(sphere)
    assert (statuses(found) == ALIGNED).all()
    assert all(height_field.aligned.all() for height_field in found.buckets)
    assert "aligned_patches" not in figures(sphere)
    assert figures(found)["aligned_patches"] == found.patches.num_patches
    assert figures(found)["mismatch"] == float(found.mismatch[-1])


def test_a_patch_without_height_field_is_alone_and_stays_as_it_is(
    facets_over, height_fields, sphere_height_field
):
    sphere = height_fields(facets_over(cap), sphere_height_field(CENTER, RADIUS))

    def blind(height_field):
        valid = height_field.valid.clone()
        valid[0] = False
        return height_field.replace(valid=valid)

    found = Align()(with_first(sphere, blind))
    assert statuses(found)[0] == ALONE
    assert (statuses(found)[1:] == ALIGNED).all()
    identity = torch.tensor([0.0, 0, 1, 0], dtype=torch.float64)
    assert_close(found.buckets[0].transform[0], identity)


def test_a_patch_with_height_field_in_its_centre_only_is_alone(
    facets_over, height_fields, sphere_height_field
):
    patches = facets_over(cap, side=4)
    sphere = height_fields(patches, sphere_height_field(CENTER, RADIUS))

    def islet(height_field):
        valid = height_field.valid.clone()
        valid[0] &= (patches.buckets[0].barycentric[0] > 0.25).all(dim=-1)
        return height_field.replace(valid=valid)

    found = Align()(with_first(sphere, islet))
    assert statuses(found)[0] == ALONE
    # A facet in a corner of the mesh has no other neighbour.
    assert (statuses(found) == ALONE).sum() <= 2
    assert not (statuses(found) == DISPUTED).any()


def test_a_patch_of_nonsense_is_disputed_put_on_its_vertices_and_drags_nobody(
    facets_over, height_fields, sphere_height_field, generator
):
    patches = facets_over(cap)
    sphere = height_fields(patches, sphere_height_field(CENTER, RADIUS))
    x, y, _ = patches.buckets[0].points_patch[0].unbind(dim=-1)
    waves = 0.25 * torch.sin(23 * x + 1) * torch.cos(19 * y)

    def nonsense(height_field):
        depth = height_field.depth.clone()
        depth[0] = waves + 0.6
        return height_field.replace(depth=depth)

    found = Align()(with_first(sphere, nonsense))
    assert statuses(found)[0] == DISPUTED
    assert (statuses(found)[1:] == ALIGNED).all()
    others = torch.cat([height_field.transform for height_field in found.buckets])[1:]
    away = others - torch.tensor([0.0, 0, 1, 0], dtype=torch.float64)
    assert away.abs().mean() < 0.01
    anchors = vertex_anchors(patches, found.buckets)
    own = anchors.facet == patches.buckets[0].facet[0]
    assert_close(anchors.samples[own, 2], torch.zeros(3).double(), atol=1e-3, rtol=0)


def test_a_seam_is_reliable_where_enough_of_it_agrees():
    met = torch.ones(4, 8, dtype=torch.bool)
    met[1, 1:] = False  # hardly met
    reliability = torch.ones(4, 8)
    reliability[2] = 0.2  # nearly all far apart
    reliability[3, :5] = 0.1  # the others agree
    assert reliable_seams(reliability, met).tolist() == [True, False, False, True]
    facets = torch.tensor([[0, 1], [1, 2], [2, 3], [4, 5]])
    overlapping = overlapping_seams(met)
    assert overlapping.tolist() == [True, False, True, True]
    overlapping[3] = False
    found = judge_patches(facets, overlapping, reliable_seams(reliability, met), 7)
    wanted = [ALIGNED, ALIGNED, DISPUTED, DISPUTED, ALONE, ALONE, ALONE]
    assert found.tolist() == wanted


def test_with_infinite_outlier_distance_nobody_is_disputed(facets_over, height_fields, generator):
    wild = height_fields(
        facets_over(lambda x, y: 0 * x),
        lambda points, _: torch.randn(points.shape[:3], generator=generator, dtype=torch.float64),
    )
    found = Align(AlignConfig(outlier=float("inf")))(wild)
    assert not (statuses(found) == DISPUTED).any()
