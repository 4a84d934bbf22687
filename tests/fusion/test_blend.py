"""Normals, offsets and variances of blended patches at shared vertices."""

import math

import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_torch.geometry.subdivision import subdivide
from pimper_torch.records import Heights, SweptPatches
from pimper_torch.stages.fusion.blend import blend_patches, ray_directions, vertex_spacing
from pimper_torch.stages.fusion.problem import transferred_height_fields

FIRST, SECOND = 400.0, 100.0  # inverse variances
LEAN = torch.tensor([0.2, 0.0, 0.0], dtype=torch.float64)


@pytest.fixture
def blended(lift):
    """Blend two facets whose normals and heights differ, and mark the middle of their seam."""

    def blend(known=True):
        photometric = lift(0.0).photometric
        photometry, heights = [], []
        for templates, found in zip(photometric.patches.buckets, photometric.buckets, strict=True):
            second = (templates.facet == 1)[:, None, None].expand_as(found.valid)
            information = torch.where(second, SECOND, FIRST).double()
            valid = found.valid & (known | ~second)
            leaning = normalize(found.normals_patch + LEAN * second[..., None], dim=-1)
            photometry.append(
                found.replace(normals_patch=leaning, valid=valid, information=information * valid)
            )
            heights.append(
                Heights(
                    offset=second.double(),
                    information=information * valid,
                    num_views=torch.ones_like(templates.facet),
                )
            )
        swept = SweptPatches(
            photometric=photometric.replace(buckets=tuple(photometry)),
            buckets=tuple(heights),
            averaged=1.0,
        )
        coarse = swept.patches.coarse
        spacing = vertex_spacing(swept.patches, 1.0)
        subdivision = subdivide(coarse.mesh.vertices_world, coarse.mesh.faces, spacing)
        found = blend_patches(
            transferred_height_fields(swept),
            subdivision,
            ray_directions(subdivision, coarse),
            4.0,
            swept.buckets,
        )
        # The facets (0, 1, 2) and (0, 2, 3), in either winding, share 0 and 2.
        seam = subdivision.barycentric.amin(dim=1) < 1e-9
        ends = (subdivision.points - coarse.mesh.vertices_world[[0, 2], None]).norm(dim=2)
        along = (ends.sum(dim=0) - ends[:, seam].sum(dim=0).amin()).abs() < 1e-9
        return found, seam & along & (ends.amin(dim=0) > 0.3 * ends.amax(dim=0))

    return blend


def normals_of_the_facets(blended):
    found, _ = blended()
    return [found.normals_world[found.normal_information == each][0] for each in (FIRST, SECOND)]


def test_normals_and_offsets_of_a_seam_are_weighted_by_their_inverse_variances(blended):
    found, seam = blended()
    assert seam.sum() > 10
    first, second = normals_of_the_facets(blended)
    mean = normalize(FIRST * first + SECOND * second, dim=0)
    assert_close(found.normals_world[seam], mean.expand(int(seam.sum()), 3))
    assert_close(found.offsets[seam], torch.full((int(seam.sum()),), 0.2).double())


def test_the_inverse_variance_of_a_seam_is_the_mean_of_both(blended):
    # Patches of the same photographs share errors: the sum would count them twice.
    found, seam = blended()
    wanted = torch.full((int(seam.sum()),), (FIRST + SECOND) / 2).double()
    assert_close(found.normal_information[seam], wanted)
    assert_close(found.offset_information[seam], wanted)


def test_a_patch_without_normals_only_raises_the_variance(blended):
    found, seam = blended(known=False)
    first, _ = normals_of_the_facets(blended)
    assert_close(found.normals_world[seam], first.expand(int(seam.sum()), 3))
    # Half of the weight has normals: twice the variance, plus 8 degrees for the other half.
    variance = torch.full((int(seam.sum()),), 2 / FIRST + math.radians(8) ** 2).double()
    assert_close(1 / found.normal_information[seam], variance)
    unknown = found.normal_information == 0
    assert unknown.any()
    assert not found.seen[unknown].any()
    assert (found.normals_world[unknown] == 0).all()
