import math
from dataclasses import replace

import pytest
import torch
from torch.nn.functional import interpolate, normalize
from torch.testing import assert_close

import pimper_torch as pt
from pimper_bench.derivatives import check_derivatives
from pimper_torch.geometry.rigid import rotate
from tests.patches.conftest import TILTED

NORMAL = normalize(torch.tensor(TILTED.normal, dtype=torch.float64), dim=0)


@pytest.fixture
def patches(plane_mesh, plane_scene):
    return pt.Decompose()(plane_mesh, plane_scene.cameras)


def normal_prior(scene, frame="camera", variance=0.01) -> pt.NormalPrior:
    views, cameras = scene.views, scene.cameras
    normals = NORMAL.expand(*views.images[:, 0].shape, 3)
    if frame == "camera":
        normals = torch.einsum("vij,vhwj->vhwi", cameras.cam_from_world[:, :3, :3], normals)
    variances = torch.full_like(views.images[:, 0], variance)
    return pt.NormalPrior(
        names=views.names, sizes_px=views.sizes_px, normals=normals, variance=variances, frame=frame
    )


def depth_prior(scene, raised: float = 0.0) -> pt.DepthPrior:
    """Return the plane's depth along each camera axis, raised along the plane's normal."""
    views, cameras = scene.views, scene.cameras
    height, width = views.images.shape[2:]
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([x, y, torch.ones_like(x)], dim=-1).double()
    rays = torch.einsum("vij,hwj->vhwi", torch.linalg.inv(cameras.intrinsics), pixels)
    along = torch.einsum("vij,vhwi->vhwj", cameras.cam_from_world[:, :3, :3], rays)
    start = cameras.centers_world @ NORMAL
    depth = (raised - start)[:, None, None] / (along @ NORMAL)
    return pt.DepthPrior(
        names=views.names,
        sizes_px=views.sizes_px,
        depth=depth,
        variance=torch.full_like(depth, 1e-4),
        gauge="scene",
    )


def guessed(scene, patches, *priors, warp=None):
    views = scene.views.replace(priors=priors)
    seen = (warp or pt.Warp())(views, scene.cameras, patches)
    return seen, [bucket.priors for bucket in seen.buckets]


@pytest.mark.parametrize("frame", ["camera", "world"])
def test_prior_normals_are_in_the_patch_frame_and_information_adds_up(plane_scene, patches, frame):
    seen, found = guessed(plane_scene, patches, normal_prior(plane_scene, frame))
    for bucket, templates, own in zip(seen.buckets, patches.buckets, found, strict=True):
        views = bucket.valid.sum(dim=1)
        true = rotate(templates.patch_from_world, NORMAL.expand(len(templates.facet), 1, 3))
        some = views == 5
        assert bool(some.any())
        assert_close(own.normals_patch[some], true[:, :, None].expand_as(own.normals_patch)[some])
        assert_close(own.normal_information[some], torch.full_like(own.offset[some], 500.0))
        assert not own.offset_information.any()


def test_maps_at_half_size_give_the_same_offsets(plane_scene, patches):
    prior = depth_prior(plane_scene, 0.03).take([0, 3])
    small = interpolate(prior.depth[:, None], scale_factor=0.5, mode="area")[:, 0]
    half = prior.replace(
        depth=small, variance=torch.full_like(small, 1e-4), sizes_px=prior.sizes_px // 2
    )
    _, whole = guessed(plane_scene, patches, prior)
    _, halved = guessed(plane_scene, patches, half)
    for one, other in zip(whole, halved, strict=True):
        both = (one.offset_information > 0) & (other.offset_information > 0)
        assert bool(both.any())
        assert_close(one.offset[both], other.offset[both], rtol=0, atol=1e-4)


def test_depth_priors_become_offsets_along_the_normal(plane_scene, patches):
    _, found = guessed(plane_scene, patches, depth_prior(plane_scene, 0.03))
    for own in found:
        some = own.offset_information > 0
        assert_close(own.offset[some], torch.full_like(own.offset[some], 0.03), rtol=0, atol=1e-4)
        # Five views with errors of 0.01 along their axes, and about as much along the normal.
        assert 5e4 < own.offset_information[some].max() < 7e4


def test_disagreeing_views_are_weighted_by_their_scatter(plane_scene, patches):
    tilted = normal_prior(plane_scene, variance=1e-4)
    lean = math.radians(10) * torch.tensor([1.0, -1, 0, 1, -1]).double()
    axis = torch.tensor([1.0, 0, 0]).double()
    across = normalize(axis - (tilted.normals @ axis)[..., None] * tilted.normals, dim=-1)
    wrong = normalize(tilted.normals + lean[:, None, None, None] * across, dim=-1)
    seen, found = guessed(plane_scene, patches, tilted.replace(normals=wrong))
    for bucket, own in zip(seen.buckets, found, strict=True):
        some = bucket.valid.sum(dim=1) == 5
        # The mean square of five tilts about their mean, over five.
        scatter = math.radians(10) ** 2 / 5
        expected = torch.full_like(own.offset[some], 1 / scatter)
        assert_close(own.normal_information[some], expected, rtol=0.1, atol=0)


def test_kernels_and_torch_sample_the_same_priors(plane_scene, patches):
    priors = normal_prior(plane_scene), depth_prior(plane_scene, 0.02)
    scene = plane_scene.to(torch.float32)
    single = [prior.to(torch.float32) for prior in priors]
    _, fast = guessed(scene, patches.to(torch.float32), *single)
    _, exact = guessed(plane_scene, patches, *priors)
    for one, other in zip(fast, exact, strict=True):
        both = (one.normal_information > 0) & (other.normal_information > 0)
        assert (one.normal_information > 0).ne(other.normal_information > 0).float().mean() < 1e-3
        assert_close(one.normals_patch[both].double(), other.normals_patch[both], rtol=0, atol=1e-4)
        assert_close(one.offset[both].double(), other.offset[both], rtol=0, atol=1e-4)


def test_unknown_pixels_and_other_photographs_give_no_information(plane_scene, patches):
    prior = normal_prior(plane_scene)
    unknown = prior.replace(variance=torch.full_like(prior.variance, math.inf))
    strange = prior.replace(names=tuple(f"other {name}" for name in prior.names))
    for silent in (unknown, strange):
        seen, found = guessed(plane_scene, patches, silent)
        assert not any(own is not None and own.normal_information.any() for own in found)
        plain = pt.Warp()(plane_scene.views, plane_scene.cameras, patches)
        for one, other in zip(seen.buckets, plain.buckets, strict=True):
            assert torch.equal(one.radiance, other.radiance)
            assert torch.equal(one.valid, other.valid)


def test_inlier_priors_apply_to_their_view_and_are_1_elsewhere(plane_scene, patches):
    views = plane_scene.views
    half = pt.InlierPrior(
        names=views.names[1:2],
        sizes_px=views.sizes_px[1:2],
        probability=torch.full_like(views.images[1:2, 0], 0.25),
    )
    seen, found = guessed(plane_scene, patches, half)
    for bucket, own in zip(seen.buckets, found, strict=True):
        valid = bucket.valid
        assert_close(
            own.inlier[:, 1][valid[:, 1]], torch.full_like(own.inlier[:, 1], 0.25)[valid[:, 1]]
        )
        assert bool((own.inlier[:, [0, 2, 3, 4]] == 1).all())


def test_gradients_with_respect_to_the_maps_match_differences(plane_scene, patches):
    depth, normals = depth_prior(plane_scene, 0.02), normal_prior(plane_scene)
    part = patches.replace(buckets=(patches.buckets[0],))
    noise = torch.randn(normals.normals.shape, generator=torch.Generator().manual_seed(1)).double()
    normals = normals.replace(normals=normalize(normals.normals + 0.1 * noise, dim=-1))

    def merged_of(inputs):
        own_depth = depth.replace(depth=inputs["depth"])
        own_normals = normals.replace(normals=inputs["normals"])
        own = guessed(plane_scene, part, own_depth, own_normals)[1][0]
        return {
            "offset": own.offset,
            "normals": own.normals_patch,
            "information": own.normal_information,
        }

    checks = check_derivatives(
        merged_of,
        {"depth": depth.depth, "normals": normals.normals},
        torch.Generator().manual_seed(2),
    )
    for name in ("offset", "normals", "information"):
        by = "depth" if name == "offset" else "normals"
        assert abs(checks[by, name].ratio - 1) < 1e-5, name


def test_depth_in_other_than_scene_units_is_rejected(plane_scene, patches):
    loose = replace(depth_prior(plane_scene), gauge="affine")
    with pytest.raises(pt.InputError, match="scene units"):
        guessed(plane_scene, patches, loose)


@pytest.mark.parametrize("frame", ["camera", "world"])
def test_prior_lights_shade_the_same_in_the_patch_frame(plane_scene, patches, frame):
    views, cameras = plane_scene.views, plane_scene.cameras
    lights = torch.randn(5, 4, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    own = lights
    if frame == "camera":
        rotated = (cameras.cam_from_world[:, :3, :3] @ lights[:, 1:, None])[..., 0]
        own = torch.cat([lights[:, :1], rotated], dim=1)
    given = pt.LightPrior(
        lights=own[1:], variance=torch.ones(4).double(), names=views.names[1:], frame=frame
    )
    _, found = guessed(plane_scene, patches, given)
    for templates, each in zip(patches.buckets, found, strict=True):
        normal = rotate(templates.patch_from_world, NORMAL.expand(len(templates.facet), 1, 3))
        shading = each.lights_patch[..., 0] + (each.lights_patch[..., 1:] * normal).sum(dim=-1)
        expected = lights[:, 0] + lights[:, 1:] @ NORMAL
        assert_close(shading[:, 1:], expected[1:].expand(len(shading), 4))
        assert bool(each.light_variance[:, 0].isinf().all())
        assert not each.normal_information.any()
