import pytest
import torch
from torch.testing import assert_close

from pimper_torch.geometry.pyramids import look_up, pyramid_level
from pimper_torch.geometry.rigid import invert_rigid
from pimper_torch.records import CoarseMesh, Mesh
from pimper_torch.runtime.errors import ConfigError
from pimper_torch.stages.patches.decompose import Decompose
from pimper_torch.stages.patches.patches_config import WarpConfig
from pimper_torch.stages.patches.warp import Warp
from tests.patches.test_transfer import places


@pytest.fixture
def registered(plane_scene, plane_mesh):
    patches = Decompose()(plane_mesh, plane_scene.cameras)
    return Warp()(plane_scene.views, plane_scene.cameras, patches)


def test_every_view_gives_the_albedo_at_each_sample_point(registered):
    for templates, seen in zip(registered.patches.buckets, registered.buckets, strict=True):
        points = places(templates)
        x, y = points[..., 0], points[..., 1]
        truth = torch.stack([0.5 + 0.2 * x, 0.5 + 0.2 * y, 0.5 - 0.1 * x + 0.1 * y], dim=1)
        error = (seen.radiance - truth[:, None]).abs() * seen.valid[:, :, None]
        # A ramp on a plane is not quite a ramp in a perspective image: its curvature over a
        # pixel is far below 1e-3, half a pixel of misplacement is 1.5e-3.
        assert error.max() < 4e-4
        assert (seen.valid & templates.inside[:, None]).float().mean() > 0.2


def test_missing_samples_are_zero(registered):
    for seen in registered.buckets:
        assert (seen.radiance * ~seen.valid[:, :, None]).abs().max() == 0
    counts = registered.figures()
    assert 0 <= counts["missing_samples"] < 0.2 * counts["samples"]


def test_viewers_are_directions_to_the_cameras(registered, plane_scene):
    for templates, seen in zip(registered.patches.buckets, registered.buckets, strict=True):
        world_from_patch = invert_rigid(templates.patch_from_world)
        toward = plane_scene.cameras.centers_world - world_from_patch[:, None, :3, 3]
        found = seen.viewers.to(toward) @ world_from_patch[:, :3, :3].mT
        assert_close(found, toward / toward.norm(dim=-1, keepdim=True), atol=1e-6, rtol=0)


def test_saturated_dark_masked_and_outside_samples_are_missing(plane_scene, plane_mesh):
    patches = Decompose()(plane_mesh, plane_scene.cameras)
    images = plane_scene.views.images.clone()
    images[0] = 1.0
    images[1] = 0.005
    masks = plane_scene.views.inside.clone()
    masks[2] = False
    views = plane_scene.views.replace(images=images, masks=masks)
    shifted = plane_scene.cameras.intrinsics.clone()
    shifted[3, 0, 2] += 1000  # view 3 has the object outside its frame
    cameras = plane_scene.cameras.replace(intrinsics=shifted)
    for seen in Warp()(views, cameras, patches).buckets:
        valid = seen.valid.sum(dim=(0, 2, 3))
        assert valid[:4].tolist() == [0, 0, 0, 0]
        assert valid[4] > 0


def test_an_averted_facet_is_not_seen(plane_scene, plane_mesh):
    flipped = plane_mesh.replace(mesh=plane_mesh.mesh.replace(faces=plane_mesh.mesh.faces.flip(1)))
    patches = Decompose()(flipped, plane_scene.cameras)
    for seen in Warp()(plane_scene.views, plane_scene.cameras, patches).buckets:
        assert not seen.valid.any()


def test_a_facet_in_front_hides_the_one_behind(plane_scene, plane_mesh):
    vertices, faces = plane_mesh.mesh.vertices_world, plane_mesh.mesh.faces
    cover = 0.5 * vertices + torch.tensor([0.0, 0.0, 0.8], dtype=torch.float64)
    both = CoarseMesh(
        mesh=Mesh(vertices_world=torch.cat([vertices, cover]), faces=torch.cat([faces, faces + 4])),
        reference=2,
        is_point=torch.ones(8, dtype=torch.bool),
    )
    patches = Decompose()(both, plane_scene.cameras)
    seen = Warp()(plane_scene.views, plane_scene.cameras, patches)
    center = plane_scene.cameras.centers_world[2]
    for templates, bucket in zip(patches.buckets, seen.buckets, strict=True):
        points = places(templates)
        # Intersections of rays to the centre of view 2 with the cover, in its barycentrics.
        normal = torch.linalg.cross(cover[1] - cover[0], cover[2] - cover[0])
        ray = center - points
        reach = ((cover[0] - points) @ normal) / (ray @ normal)
        at = points + reach[..., None] * ray
        covered = torch.zeros_like(templates.inside)
        deep = torch.zeros_like(templates.inside)
        for face in faces:
            a, b, c = cover[face]
            inverse = torch.linalg.inv(torch.stack([a, b, c], dim=1))
            weights = at @ inverse.mT
            covered |= (weights > -0.08).all(dim=-1)
            deep |= (weights > 0.08).all(dim=-1)
        behind = (reach > 1e-3) & (reach < 1) & (templates.facet < 2)[:, None, None]
        assert not (bucket.valid[:, 2] & deep & behind).any()
        free = templates.inside & ~covered & (templates.facet < 2)[:, None, None]
        assert (bucket.valid[:, 2] | ~free).float().mean() > 0.98


def test_pyramid_level_is_the_logarithm_of_the_footprint():
    rows, columns = torch.meshgrid(torch.arange(6.0), torch.arange(8.0), indexing="ij")
    for footprint, level in ((0.5, 0.0), (1.0, 0.0), (2.0, 1.0), (8.0, 3.0)):
        pixels = footprint * torch.stack([columns, rows], dim=-1)[None]
        assert_close(pyramid_level(pixels), torch.full((1, 6, 8), level))


def test_a_fine_stripe_pattern_seen_from_far_averages_out():
    stripes = (torch.arange(64) % 2).float().expand(1, 64, 64)
    coarse = torch.nn.functional.avg_pool2d(stripes[None], 4)[0]
    level_2 = coarse.expand(1, 16, 16)
    level_1 = torch.nn.functional.avg_pool2d(stripes[None], 2)[0]
    rows, columns = torch.meshgrid(torch.arange(12.0), torch.arange(12.0), indexing="ij")
    pixels = (4 * torch.stack([columns, rows], dim=-1) + 8.5)[None]
    level = pyramid_level(pixels)
    sampled = look_up([stripes, level_1, level_2], pixels.reshape(-1, 2), level.flatten())
    assert_close(sampled, torch.full_like(sampled, 0.5))


def test_impossible_settings_are_rejected():
    with pytest.raises(ConfigError, match="saturation_level"):
        WarpConfig(dark_level=0.5, saturation_level=0.4)
    with pytest.raises(ConfigError, match="max_tilt_deg"):
        WarpConfig(max_tilt_deg=90.0)


def test_nan_pixels_are_missing_and_do_not_affect_others(plane_scene, plane_mesh):
    patches = Decompose()(plane_mesh, plane_scene.cameras)
    images = plane_scene.views.images.clone()
    rows, columns = images.shape[-2] // 2, images.shape[-1] // 2
    images[0, 1, rows, columns] = torch.nan
    images[0, 0, rows, columns + 5] = -torch.inf
    holed = Warp()(plane_scene.views.replace(images=images), plane_scene.cameras, patches)
    whole = Warp()(plane_scene.views, plane_scene.cameras, patches)
    lost = 0
    for found, wanted in zip(holed.buckets, whole.buckets, strict=True):
        assert found.radiance.isfinite().all()
        assert not (found.valid & ~wanted.valid).any()
        lost += int((wanted.valid & ~found.valid).sum())
        same = found.valid & wanted.valid
        off = (found.radiance - wanted.radiance).abs().amax(dim=2)[same]
        assert off.max() < 0.1  # of the fraction of a pixel that a sample may lack
    assert 0 < lost < 60
