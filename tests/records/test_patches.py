"""Records of patches made from tensors."""

import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

import pimper_torch as pt
from pimper_torch.records import PatchStatus


def taken_apart(found):
    """Return normals, albedo, lights and information of photometry per bucket."""
    names = {"normals": "normals_patch", "lights": "lights_patch"}
    return {
        name: [getattr(bucket, names.get(name, name)) for bucket in found.buckets]
        for name in ("normals", "lights", "albedo", "information")
    }


def test_photometry_is_reassembled_from_its_parts(lift):
    true = lift(0.0).photometric
    found = pt.PhotometricPatches.of(true.patches, **taken_apart(true))
    for made, own in zip(found.buckets, true.buckets, strict=True):
        assert_close(made.normals_patch[made.valid], own.normals_patch[own.valid])
        for name in ("albedo", "lights_patch", "valid", "status"):
            assert_close(getattr(made, name), getattr(own, name))
        assert_close(made.information, own.information * own.valid)
        assert bool(made.convergence.converged.all())


def test_world_lights_are_rotated_to_patches_and_residuals_are_of_the_views(lift):
    plane = lift(0.0)
    true = plane.photometric
    parts = taken_apart(true)
    bare = pt.PhotometricPatches.of(
        true.patches, normals=parts["normals"], lights=plane.scene.lights_world
    )
    for made, own in zip(bare.buckets, true.buckets, strict=True):
        assert_close(made.lights_patch, own.lights_patch)
        assert made.albedo.unique().tolist() == [1]
        assert made.convergence.residual.unique().tolist() == [0]
    # Albedo is the median quotient of radiance and shading under these lights.
    albedo = []
    for views, made in zip(plane.seen.buckets, bare.buckets, strict=True):
        quotient = torch.where(views.valid[:, :, None], views.radiance / made.predicted, torch.nan)
        albedo.append(quotient.nanmedian(dim=1).values.nan_to_num(0).movedim(1, -1))
    found = pt.PhotometricPatches.of(
        plane.seen, normals=parts["normals"], lights=plane.scene.lights_world, albedo=albedo
    )
    residual = torch.cat([bucket.convergence.residual for bucket in found.buckets])
    assert 0 < residual.max() < 0.03  # speckle is interpolated between pixels
    other = [0.5 * values for values in albedo]
    half = pt.PhotometricPatches.of(
        plane.seen, normals=parts["normals"], lights=plane.scene.lights_world, albedo=other
    )
    level = torch.cat([v.gray[v.valid] for v in plane.seen.buckets]).square().mean().sqrt()
    assert_close(half.buckets[0].convergence.residual.mean(), level.double() / 2, rtol=0.1, atol=0)


def test_samples_without_a_normal_are_invalid_and_their_patch_is_unobserved(lift):
    true = lift(0.0).photometric
    parts = taken_apart(true)
    normals = [3 * values.clone() for values in parts["normals"]]  # of any length
    normals[0][0] = 0
    normals[0][1, 0] = torch.nan
    found = pt.PhotometricPatches.of(true.patches, **{**parts, "normals": normals})
    first = found.buckets[0]
    assert first.status.tolist()[:2] == [PatchStatus.UNSEEN, PatchStatus.DETERMINED]
    assert not bool(first.valid[0].any() | first.valid[1, 0].any())
    assert_close(first.normals_patch, normalize(first.normals_patch, dim=-1))
    assert bool((first.information[~first.valid] == 0).all())
    away = [-values for values in parts["normals"]]
    turned = pt.PhotometricPatches.of(true.patches, **{**parts, "normals": away})
    assert not bool(turned.buckets[0].valid.any())


def test_values_that_do_not_match_the_patches_are_refused(lift):
    true = lift(0.0).photometric
    parts = taken_apart(true)
    with pytest.raises(
        pt.InputError, match="normals has 0 entries; needed: one tensor for each of"
    ):
        pt.PhotometricPatches.of(true.patches, **{**parts, "normals": []})
    small = [values[:, :2] for values in parts["normals"]]
    with pytest.raises(pt.InputError, match="normals of a bucket have shape"):
        pt.PhotometricPatches.of(true.patches, **{**parts, "normals": small})
    nowhere = [torch.full_like(values, torch.nan) for values in parts["albedo"]]
    with pytest.raises(pt.InputError, match="albedo"):
        pt.PhotometricPatches.of(true.patches, **{**parts, "albedo": nowhere})


def test_the_repr_of_a_result_has_a_few_lines(reconstruction):
    shown = str(reconstruction)
    assert len(shown) < 600
    assert len(shown.splitlines()) == 14
    assert "  mesh: Mesh(vertex 225, face 392, channel 3)" in shown
    assert "  patches: DepthPatches(patch 2)" in shown
    assert "  report: 2 StageReport" in shown
    assert len(str(reconstruction.scene)) < 800
