import pytest
import torch
from torch.testing import assert_close

from pimper_bench.datasets import read_rendered
from pimper_bench.scenes import SceneConfig, render_scene
from pimper_bench.scenes.random_bodies import FAMILIES, SIZE, random_body
from pimper_bench.scenes.random_captures import render_random
from pimper_bench.scenes.random_clouds import detectability, local_contrast, whole_windows
from pimper_bench.scenes.random_draws import Draws
from pimper_bench.scenes.random_photographs import Sensor, stored
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import project, rays_through
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.io.meshes import write_ply
from pimper_torch.radiometry import srgb_from_linear


def small(seed, meshes=(), **changes):
    return render_random(seed, meshes, **({"num_views": 4, "width": 64, "height": 48} | changes))


@pytest.fixture(scope="module", params=[0, 5])
def capture(request):
    return small(request.param, width=96, height=72)


def test_a_seed_gives_the_same_bits_and_another_one_a_different_scene():
    first, again, other = small(1), small(1), small(2)
    assert torch.equal(first.views.images, again.views.images)
    assert torch.equal(first.depth, again.depth)
    assert torch.equal(first.cameras.cam_from_world, again.cameras.cam_from_world)
    assert torch.equal(first.scene.points_world, again.scene.points_world)
    assert torch.equal(first.scene.observation_pixels, again.scene.observation_pixels)
    assert not torch.equal(first.views.images, other.views.images)
    assert not torch.equal(first.cameras.cam_from_world, other.cameras.cam_from_world)


def test_the_foreground_is_where_the_depth_is_that_of_the_object(capture):
    caster = RayCaster(capture.mesh.vertices_world, capture.mesh.faces)
    cameras = capture.cameras
    pixels = pixel_centers(96, 72, like=cameras.intrinsics).reshape(-1, 2)
    for view in range(4):
        rays = rays_through(pixels, cameras.cam_from_world[view], cameras.intrinsics[view])
        alone = caster.cast(cameras.centers_world[view], rays).distance.reshape(72, 96)
        equal = (alone - capture.depth[view]).abs() < 1e-4 * alone
        foreground = capture.foreground[view]
        assert foreground.float().mean() > 0.02
        assert (equal | ~foreground).all()
        # The object may hide behind nothing: it stands on the table, above which the camera is.
        assert (foreground == alone.isfinite()).float().mean() > 0.995


def test_photographs_have_256_levels_and_cameras_are_above_the_table(capture):
    levels = 255 * srgb_from_linear(capture.views.images)
    assert_close(levels, levels.round(), atol=2e-3, rtol=0)
    assert capture.cameras.centers_world[:, 2].min() > 0.5
    assert capture.cameras.intrinsics.dtype == torch.float64
    seen, _ = project(
        capture.mesh.vertices_world, capture.cameras.cam_from_world, capture.cameras.intrinsics
    )
    assert (seen > -0.02 * 96 - 1e-6).all()
    assert (seen < 1.02 * seen.new_tensor([96, 72]) + 1e-6).all()


def test_points_of_the_cloud_project_to_their_observations(capture):
    sparse = capture.scene
    count = len(sparse.points_world)
    assert 30 < count <= 3000
    pixels, _ = project(
        sparse.points_world, sparse.cameras.cam_from_world, sparse.cameras.intrinsics
    )
    there = pixels[sparse.observation_view, sparse.observation_point]
    off = (there - sparse.observation_pixels).norm(dim=1)
    assert 0.05 < off.median() < 0.4  # 0.3 px in both directions, less what the point absorbs
    assert off.quantile(0.99) < 1.5
    tracks = sparse.observed.sum(dim=1)
    assert tracks.min() == 3
    assert tracks.max() == 4


def test_most_points_are_on_a_surface_and_few_are_gross_outliers(capture):
    sparse, cameras = capture.scene, capture.cameras
    _, along = project(sparse.points_world.double(), cameras.cam_from_world, cameras.intrinsics)
    u, v = sparse.observation_pixels.floor().long().unbind(dim=1)
    shown = capture.depth[sparse.observation_view, v.clamp(0, 71), u.clamp(0, 95)]
    off = (along[sparse.observation_view, sparse.observation_point] - shown).abs() / shown
    assert (off < 0.15).float().mean() > 0.9
    assert (off > 0.15).any()


def test_contrast_is_texture_and_neither_shading_nor_outlines():
    generator = torch.Generator().manual_seed(3)
    ramp = torch.linspace(0.3, 0.6, 60).expand(40, 60)
    surface = torch.zeros(40, 60, dtype=torch.int64)
    surface[:, 30:] = 1
    noisy = (0.1 * torch.randn(40, 60, generator=generator)).exp()
    noisy[:, 30:] = 1
    bright = torch.where(surface == 1, 1.5, 1.0)  # a step at the outline
    image = (ramp * noisy * bright).expand(3, -1, -1)
    clear = whole_windows(surface)
    assert clear[3:-3, 3:27].all()
    assert not clear[:, 27:33].any()
    contrast = local_contrast(image, clear)
    inside = contrast[6:-6, 6:24]
    assert 0.06 < inside.median() < 0.12  # 0.1, less the window's mean
    assert contrast[6:-6, 30:54].max() < 0.02
    assert (contrast[:, 29:31] == 0).all()
    chance = detectability(image, image, surface)
    assert (chance[6:-6, 30:] == 0).all()
    assert 0.2 < chance[6:-6, 6:24].median() < 0.8
    plain = detectability(image, torch.ones_like(image), surface)
    assert_close(plain[6:-6, 6:24], 0.2 * inside.sub(0.02).div(0.13).clamp(0, 1))


def test_points_are_detected_where_there_is_contrast(capture):
    sparse = capture.scene
    u, v = sparse.observation_pixels.floor().long().unbind(dim=1)
    inside = (u >= 0) & (u < 96) & (v >= 0) & (v < 72)
    contrast = torch.stack(
        [
            local_contrast(image, whole_windows(kind))
            for image, kind in zip(capture.views.images, capture.surface, strict=True)
        ]
    )
    view = sparse.observation_view
    found = contrast[view[inside], v[inside], u[inside]]
    assert (found > 0.01).float().mean() > 0.9
    assert found.median() > 1.3 * contrast.median()


def test_every_family_is_drawn_within_40_seeds_at_one_size(tmp_path):
    file = tmp_path / "block.ply"
    write_ply(random_body(Draws(0, "body")).meshes[0], file)
    families: set[str] = set()
    wanted = {*FAMILIES, "several", "file"}
    for seed in range(40):
        body = random_body(Draws(seed, "body"), [file] if seed % 4 == 0 else [])
        families.add(body.family)
        points = torch.cat([mesh.vertices_world for mesh in body.meshes])
        low, high = points.aminmax(dim=0)
        assert_close(float((high - low).amax()), SIZE, atol=1e-9, rtol=0)
        assert abs(float(low[2])) < 1e-9
        assert (low + high)[:2].abs().max() < 1e-9
        if families == wanted:
            break
    assert families == wanted


def test_streams_of_draws_are_independent_and_rotations_proper():
    first, same, other = Draws(1, "room"), Draws(1, "room"), Draws(1, "table")
    numbers = first.vector(0, 1, 5)
    assert torch.equal(numbers, same.vector(0, 1, 5))
    assert not torch.equal(numbers, other.vector(0, 1, 5))
    turned = first.rotation()
    assert_close(turned @ turned.mT, torch.eye(3, dtype=torch.float64))
    assert_close(float(torch.linalg.det(turned)), 1.0)


def test_a_stored_photograph_is_rounded_noisy_or_compressed_as_stated():
    image = torch.full((3, 40, 40), 0.5)
    generator = torch.Generator().manual_seed(4)
    exact = stored(image, Sensor(noise=0, blur_px=0, quality=None), generator)
    assert_close(exact, image, atol=0.005, rtol=0)
    noisy = stored(image, Sensor(noise=0.02, blur_px=0, quality=None), generator)
    # (1/9 + 8/9 * 0.5)^0.5 of 0.02
    assert_close(float(noisy.std()), 0.0149, atol=0.001, rtol=0)
    packed = stored(image, Sensor(noise=0.02, blur_px=0, quality=70), generator)
    assert 0 < packed.std() < noisy.std()


def test_a_random_scene_is_read_from_its_folder_like_others(tmp_path):
    size = {"num_views": 4, "width": 96, "height": 72}
    render_scene("random", tmp_path / "scene", SceneConfig(seed=3, **size))
    found, said = read_rendered(tmp_path / "scene"), render_random(3, **size)
    assert found.views.names == said.views.names
    assert_close(found.views.images, said.views.images, atol=1e-6, rtol=0)
    assert torch.equal(found.views.masks, said.foreground)
    for name in ("cam_from_world", "intrinsics"):  # rotations are stored as quaternions
        there, here = getattr(found.cameras, name), getattr(said.cameras, name)
        assert_close(there, here, atol=1e-9, rtol=0)
    for name in ("depth", "foreground", "lit", "highlight"):
        assert torch.equal(getattr(found.truth, name), getattr(said, name))
    for name in ("normals_world", "albedo"):  # in half precision
        assert_close(getattr(found.truth, name), getattr(said, name), atol=1e-3, rtol=0)
    assert_close(found.truth.lights_world.float(), said.lights_world.float())
    assert_close(found.truth.mesh.vertices_world.float(), said.mesh.vertices_world.float())
    assert found.truth.surroundings.vertices_world[:, 2].max() < 1e-6  # the table


def test_first_order_light_predicts_the_photographs_of_matte_lit_surfaces():
    capture = small(0, width=96, height=72)
    light = capture.lights_world.float()
    directed = torch.einsum("vhwc,vc->vhw", capture.normals_world, light[:, 1:])
    predicted = capture.albedo * (light[:, :1, None] + directed)[..., None]
    counted = capture.foreground & capture.lit & ~capture.highlight & (directed > 0)
    for view in range(4):
        ratio = (capture.views.images[view].movedim(0, -1) / predicted[view])[counted[view]]
        assert 0.95 < ratio.median() < 1.05  # the light is near, so only its mean is exact


def test_random_normals_face_the_camera_and_are_unit_on_every_surface(capture):
    cameras = capture.cameras
    pixels = pixel_centers(96, 72, like=cameras.intrinsics).reshape(-1, 2)
    for view in range(4):
        rays = rays_through(pixels, cameras.cam_from_world[view], cameras.intrinsics[view])
        normals = capture.normals_world[view].reshape(-1, 3)
        known = (capture.surface[view] >= 0).reshape(-1)
        assert_close(normals[known].norm(dim=1), torch.ones(int(known.sum())), atol=1e-5, rtol=0)
        assert (normals[~known] == 0).all()
        facing = (normals[known] * rays[known].float()).sum(dim=1) < 0.05
        assert facing.float().mean() > 0.98  # vertex normals bend over the outline
