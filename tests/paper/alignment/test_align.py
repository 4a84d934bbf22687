import pytest
import torch
from torch.testing import assert_close

from pimper_torch.ground.geometry.rigid import invert_rigid, rigid
from pimper_torch.paper.align import Align
from pimper_torch.paper.paper_config import AlignConfig
from pimper_torch.records import AlignStatus, Mesh
from tests.paper.alignment.caps import (
    by_facet,
    random_transforms,
    spoiled,
    waves,
)


def error(found, truth):
    pairs = zip(found.buckets, truth.buckets, strict=True)
    apart = torch.cat([(a.depth - b.depth)[b.valid] for a, b in pairs])
    return float(apart.square().mean().sqrt())


@pytest.mark.parametrize(("prior", "left"), [(1e-6, 0.001), (3e-4, 0.03)])
def test_alignment_undoes_random_bas_height_field_transforms(sphere, generator, prior, left):
    put_on = random_transforms(sphere.patches.num_patches, generator)
    bad = spoiled(sphere, put_on)
    found = Align(AlignConfig(prior=prior, iterations=4))(bad)
    assert error(found, sphere) < left * error(bad, sphere)
    # Scales too, which no anchor tells: only neighbours and the folds between them do.
    scales = by_facet(found)[:, 2] * put_on[:, 2]
    assert (scales - 1).abs().mean() < 2 * left
    assert (by_facet(found)[:, 3] == 0).all()  # patches do not move along their normals
    assert found.mismatch.shape == (5,)
    assert found.mismatch[-1] < 0.02 * found.mismatch[0]


def test_depths_are_the_reported_transform_of_the_old_depths(sphere, generator):
    bad = spoiled(sphere, random_transforms(sphere.patches.num_patches, generator))
    once = Align()(bad)
    assert error(spoiled(bad, by_facet(once)), once) < 1e-12
    twice = Align()(once)
    assert error(spoiled(bad, by_facet(twice)), twice) < 1e-12


def test_no_patch_collapses_with_default_settings(facets_over, height_fields, generator):
    flat = height_fields(facets_over(lambda x, y: 0 * x), lambda points, _: 0 * points[..., 0])
    bad = waves(flat, 0.02, generator)
    scales = by_facet(Align()(bad))[:, 2]
    assert scales.min() >= 0.25
    assert scales.max() <= 4


def test_rigid_motion_and_scale_of_the_world_change_nothing(sphere, generator):
    transforms = random_transforms(sphere.patches.num_patches, generator)
    bad = spoiled(sphere, transforms)
    q, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    q = q * torch.linalg.det(q)
    size, shift = 7.0, torch.tensor([30.0, -4.0, 9.0], dtype=torch.float64)
    old_from_new = invert_rigid(rigid(q, shift))

    coarse = bad.patches.coarse
    vertices = size * coarse.mesh.vertices_world @ q.T + shift
    mesh = Mesh(vertices_world=vertices, faces=coarse.mesh.faces)
    templates = []
    for bucket in bad.patches.buckets:
        grown = bucket.patch_from_world.clone()
        grown[:, :3, 3] *= size
        templates.append(
            bucket.replace(
                patch_from_world=grown @ old_from_new,
                origin=size * bucket.origin,
                spacing=size * bucket.spacing,
            )
        )
    patches = bad.patches.replace(coarse=coarse.replace(mesh=mesh), buckets=tuple(templates))
    moved = bad.replace(
        photometric=bad.photometric.replace(patches=patches),
        buckets=tuple(
            height_field.replace(depth=size * height_field.depth) for height_field in bad.buckets
        ),
    )
    here, there = Align()(bad), Align()(moved)
    for a, b in zip(here.buckets, there.buckets, strict=True):
        assert_close(b.depth, size * a.depth, atol=1e-7, rtol=1e-7)
    assert_close(there.mismatch, size * here.mismatch)


def test_a_patch_without_data_stays_as_it_is_and_drags_nobody(sphere, generator):
    bad = spoiled(sphere, random_transforms(sphere.patches.num_patches, generator))
    blind, rest = bad.buckets[0], bad.buckets[1:]
    valid = blind.valid.clone()
    valid[0] = False
    depth = blind.depth.clone()
    depth[0] = torch.nan
    bad = bad.replace(buckets=(blind.replace(depth=depth, valid=valid), *rest))
    found = Align(AlignConfig(prior=1e-5))(bad)
    status = torch.cat([bucket.status for bucket in found.buckets])
    assert status.tolist() == [AlignStatus.ALONE] + [AlignStatus.ALIGNED] * (len(status) - 1)
    assert_close(found.buckets[0].transform[0], torch.tensor([0.0, 0, 1, 0], dtype=torch.float64))
    assert error(found.replace(buckets=_but_first(found)), _only_valid(sphere, valid)) < 0.002


def test_patches_that_meet_nobody_are_handed_back(sphere):
    nothing = tuple(
        height_field.replace(valid=height_field.valid & False) for height_field in sphere.buckets
    )
    alone = sphere.replace(buckets=nothing)
    assert Align()(alone) is alone


def _but_first(depths):
    first, *rest = depths.buckets
    return (first.replace(depth=torch.nan_to_num(first.depth)), *rest)


def _only_valid(depths, valid):
    first, *rest = depths.buckets
    return depths.replace(buckets=(first.replace(valid=valid), *rest))


def test_a_single_facet_is_handed_back(facets_over, height_fields):
    patches = facets_over(lambda x, y: 0 * x, side=2)
    mesh = patches.coarse.mesh
    first = patches.buckets[0]
    lone = patches.replace(
        coarse=patches.coarse.replace(mesh=mesh.replace(faces=mesh.faces[first.facet[:1]])),
        buckets=(_one_template(first),),
    )
    depths = height_fields(lone, lambda points, _: 0.1 * points[..., 0] ** 2)
    assert Align()(depths) is depths


def _one_template(templates):
    return templates.replace(
        facet=torch.tensor([0]),
        patch_from_world=templates.patch_from_world[:1],
        origin=templates.origin[:1],
        spacing=templates.spacing[:1],
        depth=templates.depth[:1],
        barycentric=templates.barycentric[:1],
        inside=templates.inside[:1],
    )
