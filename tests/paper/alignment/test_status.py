import torch

from pimper_torch.paper.align import Align, patch_status
from pimper_torch.records import AlignStatus
from pimper_torch.runtime.reporting import figures
from tests.paper.alignment.caps import CENTER, RADIUS, cap

ALIGNED, ALONE = (int(status) for status in AlignStatus)


def statuses(depths):
    return torch.cat([height_field.status for height_field in depths.buckets])


def with_first(depths, change):
    """Change the first patch of the first bucket."""
    first, *rest = depths.buckets
    return depths.replace(buckets=(change(first), *rest))


def test_before_alignment_nobody_is_aligned_and_after_it_all_are(sphere):
    assert all(height_field.status is None for height_field in sphere.buckets)
    assert not any(height_field.aligned.any() for height_field in sphere.buckets)
    found = Align()(sphere)
    assert (statuses(found) == ALIGNED).all()
    assert all(height_field.aligned.all() for height_field in found.buckets)
    assert "aligned_patches" not in figures(sphere)
    assert figures(found)["aligned_patches"] == found.patches.num_patches
    assert figures(found)["mismatch"] == float(found.mismatch[-1])


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


def test_a_patch_is_aligned_where_enough_of_a_seam_is_met():
    met = torch.ones(3, 8, dtype=torch.bool)
    met[1, 1:] = False  # hardly met
    facets = torch.tensor([[0, 1], [2, 3], [1, 4]])
    assert patch_status(facets, met, 6).tolist() == [ALIGNED, ALIGNED, ALONE, ALONE, ALIGNED, ALONE]
