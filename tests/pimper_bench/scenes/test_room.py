import pytest
import torch
from scenes import write_ball
from torch.testing import assert_close

from pimper_bench.datasets.rendered import read_rendered
from pimper_bench.scenes.ray_tracing import TracedObjects, render_frame
from pimper_bench.scenes.rendered_folder import render_scene
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_bench.scenes.whole_scene import build_scene
from pimper_torch.geometry.pixels import homogeneous, pixel_centers
from pimper_torch.geometry.projection import project, rays_through
from pimper_torch.geometry.rigid import transform


@pytest.fixture(scope="module")
def egg(tmp_path_factory):
    """An egg twice as long as wide, so that its image and shadow change when it turns."""
    return write_ball(tmp_path_factory.mktemp("meshes") / "egg.ply", (1.0, 2.0, 1.0))


def settings(**changes):
    calm = {"num_views": 5, "width": 80, "height": 60, "supersample": 1, "path": "turntable"}
    return SceneConfig(**(calm | {"read_noise": 0.0, "shot_noise": 0.0} | changes))


def photograph(scene, view):
    stage = TracedObjects(scene.objects_in(view))
    noise = scene.noise(view)
    return render_frame(stage, scene.cameras, scene.lights, view, noise, scene.config.sensor)


def test_the_background_is_static_except_for_the_shadow(egg):
    scene = build_scene(egg, settings(fixed_point_light=True, fixed_room=True, fixed_table=True))
    first, second = photograph(scene, 0), photograph(scene, 1)
    around = ~first.foreground & ~second.foreground
    alike = around & (first.lit == second.lit)
    assert alike.float().mean() > 0.3
    assert (around & ~alike).any()  # the shadow moved
    assert_close(first.image[:, alike], second.image[:, alike], atol=1e-4, rtol=0)  # float32
    assert first.image[:, alike].std() > 0.02  # patterned, so that equality is meaningful
    rotated = first.foreground & second.foreground
    assert (first.image - second.image).abs()[:, rotated].mean() > 0.05
    assert_close(scene.objects_in(0)[0].mesh.vertices_world, scene.object_mesh.vertices_world)


def test_an_object_turned_over_projects_correctly_and_shows_its_underside(egg):
    scene = build_scene(egg, settings(num_views=6, turned_over=True, table="patterned"))
    points = scene.object_mesh.vertices_world
    frames = [photograph(scene, view) for view in range(6)]
    for view, frame in enumerate(frames):
        pixels, _ = project(points, scene.cameras.cam_from_world[view], scene.cameras.intrinsics[0])
        rows = frame.foreground.nonzero()[:, 0].double()
        assert_close(pixels[:, 1].amin(), rows.min(), atol=1.5, rtol=0)  # rounding to pixels
        (table,) = scene.objects_in(view)[len(scene.objects) :]
        heights = table.mesh.vertices_world[:, 2]
        level = points[:, 2].max() if view >= 3 else points[:, 2].min()
        assert_close(heights, torch.full_like(heights, level), atol=1e-9, rtol=0)
    eyes = scene.cameras.centers_world
    middle = (points[:, 2].min() + points[:, 2].max()) / 2
    assert ((eyes[:, 2] < middle) == torch.tensor([False] * 3 + [True] * 3)).all()
    # The lamp is on the camera's side of the table, and lights the visible side.
    assert ((scene.lights.positions_world[:, 2] < middle) == (eyes[:, 2] < middle)).all()
    assert all((frame.lit & frame.foreground).any() for frame in frames)


def test_a_turning_table_agrees_with_the_true_cameras_and_the_room_does_not(egg):
    scene = build_scene(egg, settings(fixed_point_light=True, fixed_room=True))
    first, second = photograph(scene, 0), photograph(scene, 1)
    cameras = scene.cameras
    at = pixel_centers(80, 60, like=cameras.intrinsics).reshape(-1, 2)
    rays = rays_through(at, cameras.cam_from_world[0], cameras.intrinsics[0])
    depth = first.depth.reshape(-1).double()
    assert depth.isfinite().all()
    points = cameras.centers_world[0] + depth[:, None] * rays
    pixels, _ = project(points, cameras.cam_from_world[1], cameras.intrinsics[1])
    u, v = pixels.floor().long().unbind(dim=-1)
    framed = (u >= 0) & (v >= 0) & (u < 80) & (v < 60)
    row, column = v.clamp(0, 59), u.clamp(0, 79)
    away = transform(cameras.cam_from_world[1], points)[:, 2]
    seen = framed & ((second.depth[row, column] - away).abs() < 0.05)
    difference = (first.albedo.reshape(-1, 3) - second.albedo[row, column]).abs().mean(dim=-1)
    around = ~first.foreground.reshape(-1)
    table = around & (points[:, 2].abs() < 1e-4)
    assert (seen & table).sum() > 100
    # A pixel is 0.07 wide here, less than the table's finest pattern.
    assert difference[seen & table].mean() < 0.02
    beyond = seen & around & (points[:, 2] < -0.1)
    assert beyond.sum() > 50
    assert difference[beyond].mean() > 0.05


def test_a_fixed_point_light_is_static_relative_to_the_camera(egg):
    scene = build_scene(egg, settings(fixed_point_light=True))
    point_lights = scene.lights.positions_world[:, None]
    before = transform(scene.cameras.cam_from_world, point_lights)[:, 0]
    assert_close(before, before[:1].expand(5, 3))
    assert (point_lights[1:] - point_lights[:-1]).norm(dim=-1).min() > 1  # around the object
    assert scene.lights.irradiance.std() == 0
    target = transform(scene.cameras.cam_from_world, scene.lights.target_world.expand(5, 1, 3))
    assert_close(target, target[:1].expand(5, 1, 3))  # so the room's light is constant
    moving = build_scene(egg, settings())
    point_lights = moving.lights.positions_world[:, None]
    before = transform(moving.cameras.cam_from_world, point_lights)[:, 0]
    assert before.std(dim=0).min() > 0.1


def test_a_constant_light_is_static_relative_to_the_object(egg):
    lights = build_scene(egg, settings(constant_light=True)).lights
    moving = build_scene(egg, settings()).lights
    assert_close(lights.positions_world, moving.positions_world[:1].expand(5, 3))
    assert_close(lights.irradiance, moving.irradiance[:1].expand(5))
    assert_close(lights.target_world, moving.target_world)


@pytest.mark.parametrize("fixed_table", [False, True])
def test_the_truth_is_in_the_frame_of_the_object(egg, tmp_path, fixed_table):
    config = settings(
        num_views=3, fixed_point_light=True, fixed_room=True, fixed_table=fixed_table, bits=16
    )
    scene = build_scene(egg, config)
    capture = read_rendered(render_scene(egg, tmp_path / "out", config, processes=1))
    truth = capture.truth
    assert (truth.surroundings is None) == fixed_table
    for view in range(3):
        frame = photograph(scene, view)
        assert_close(truth.depth[view], frame.depth)
        assert_close(truth.lit[view], frame.lit)
        assert_close(capture.views.masks[view], frame.foreground)
        alone = build_scene(egg, settings(num_views=3))  # no room, no fixed point light
        bare = photograph(alone, view)
        assert_close(frame.foreground, bare.foreground)
        shown = frame.foreground
        assert_close(frame.depth[shown], bare.depth[shown])
        assert_close(frame.albedo[shown], bare.albedo[shown])
        assert_close(frame.normals_world[shown], bare.normals_world[shown])


def seen_again(scene, first, second, view):
    """Track static points between two photographs; return pixels in both, if visible."""
    cameras = scene.cameras
    at = pixel_centers(80, 60, like=cameras.intrinsics).reshape(-1, 2)
    rays = rays_through(at, cameras.cam_from_world[0], cameras.intrinsics[0])
    points = cameras.centers_world[0] + first.depth.reshape(-1, 1).double() * rays
    still = points[:, 2] < -0.1  # the floor; the wall is above its edge
    there = scene.world_from_room[view] @ scene.world_from_room[0].inverse()
    points = transform(there, points)
    pixels, _ = project(points, cameras.cam_from_world[view], cameras.intrinsics[view])
    u, v = pixels.floor().long().unbind(dim=-1)
    framed = (u >= 0) & (v >= 0) & (u < 80) & (v < 60)
    row, column = v.clamp(0, 59), u.clamp(0, 79)
    away = transform(cameras.cam_from_world[view], points)[:, 2]
    seen = still & framed & ((second.depth[row, column] - away).abs() < 0.05)
    albedo = first.albedo.reshape(-1, 3)
    followed = (albedo - second.albedo[row, column]).abs().mean(dim=-1)[seen]
    unfollowed = (albedo - second.albedo.reshape(-1, 3)).abs().mean(dim=-1)[seen]
    assert seen.sum() > 200
    # The finest pattern is smaller than a pixel (0.07 wide).
    assert followed.mean() < 0.5 * unfollowed.mean()
    return at[seen], pixels[seen]


FIXED = {"fixed_point_light": True, "fixed_room": True, "fixed_table": True}


def test_a_crop_shifts_the_static_background_as_in_the_cameras(egg):
    scene = build_scene(egg, settings(crop_jitter_px=9.0, **FIXED))
    shift = scene.cameras.intrinsics[:, :2, 2] - scene.cameras.intrinsics.new_tensor([40.0, 30.0])
    assert shift.norm(dim=1).max() < 9
    assert (shift[1:] - shift[:-1]).norm(dim=1).max() > 3
    first = photograph(scene, 0)
    for view in (2, 3):
        before, after = seen_again(scene, first, photograph(scene, view), view)
        assert_close(after - before, (shift[view] - shift[0]).expand_as(before))


def test_a_pan_moves_the_static_background_by_a_homography(egg):
    scene, calm = (build_scene(egg, settings(pan_jitter_px=px, **FIXED)) for px in (9.0, 0.0))
    in_room = [
        transform(scene.world_from_room.inverse(), scene.cameras.centers_world[:, None])[:, 0]
        for scene in (scene, calm)
    ]
    for centers in in_room:
        assert_close(centers, centers[:1].expand_as(centers))
    first = photograph(scene, 0)
    K = scene.cameras.intrinsics[0]
    in_camera = scene.cameras.cam_from_world @ scene.world_from_room
    for view in (2, 3):
        before, after = seen_again(scene, first, photograph(scene, view), view)
        turn = (in_camera[view] @ in_camera[0].inverse())[:3, :3]
        mapped = homogeneous(before) @ (K @ turn @ K.inverse()).mT
        assert_close(mapped[:, :2] / mapped[:, 2:], after)
        assert (after - before).norm(dim=1).amin() > 0.5
        assert (after - before).std(dim=0).max() < 1.5  # nearly constant: small rotation


@pytest.mark.parametrize("jitter", [{"crop_jitter_px": 12.0}, {"pan_jitter_px": 12.0}])
def test_the_object_projects_correctly_and_completely_in_every_photograph(egg, jitter):
    scene = build_scene(egg, settings(**FIXED, **jitter))
    cameras = scene.cameras
    places = []
    for view in range(5):
        pixels, _ = project(
            scene.object_mesh.vertices_world, cameras.cam_from_world[view], cameras.intrinsics[view]
        )
        assert pixels.amin() > 0
        assert (pixels.amax(dim=0) < pixels.new_tensor([80, 60])).all()
        row, column = photograph(scene, view).foreground.nonzero().unbind(dim=1)
        shown = torch.stack([column, row], dim=1).double() + 0.5
        assert_close(shown.amin(dim=0), pixels.amin(dim=0), atol=1.0, rtol=0)  # integer pixels
        assert_close(shown.amax(dim=0), pixels.amax(dim=0), atol=1.0, rtol=0)
        places.append(pixels.mean(dim=0))
    assert torch.stack(places).std(dim=0).max() > 2
