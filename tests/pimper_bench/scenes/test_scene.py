import pytest
import torch
from scenes import ball, write_ball
from scipy.spatial import KDTree
from torch.testing import assert_close

from pimper_bench.scenes import scene_objects
from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_bench.scenes.ray_tracing import TracedObjects
from pimper_bench.scenes.scene_cameras import (
    aim_to_fit,
    arc_directions,
    distance_to_fit,
    handheld_directions,
)
from pimper_bench.scenes.scene_lights import lights_round
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_bench.scenes.textures import marked, painted
from pimper_bench.scenes.whole_scene import build_scene
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import project, rays_through
from pimper_torch.io.meshes import write_ply
from pimper_torch.records import Mesh
from pimper_torch.runtime.errors import ConfigError, InputError

SMALL = SceneConfig(num_views=5, width=80, height=60)


@pytest.fixture
def egg(tmp_path):
    """A closed mesh, far from the origin, twice as long along y as across."""
    return write_ball(tmp_path / "egg.ply", (1.0, 2.0, 1.0), level=2, center=(9.0, 5.0, 7.0))


def test_the_object_fills_every_image_and_stays_inside(egg):
    for path in ("arc", "turntable", "handheld"):
        scene = build_scene(egg, SceneConfig(num_views=7, width=80, height=60, path=path))
        points = scene.object_mesh.vertices_world
        pixels, _ = project(points, scene.cameras.cam_from_world, scene.cameras.intrinsics)
        half = pixels.new_tensor([40.0, 30.0])
        reach = ((pixels - half) / half).abs()
        assert reach.max() < 0.94 + 1e-6
        assert reach.amax(dim=(1, 2)).max() > 0.93


def test_an_aim_is_better_than_the_centre_of_the_box(generator):
    points = torch.rand(60, 3, generator=generator, dtype=torch.float64)
    points[:, 2] **= 4  # mostly at low z
    toward = arc_directions(5, span_deg=50.0, elevation_deg=40.0, sway_deg=4.0)
    view = {"focal_px": 100.0, "width": 80.0, "height": 60.0, "fill": 0.9}

    def size(target, distance):
        """Return the mean image scale at the object's centre."""
        eyes = target + distance * toward
        centre = (points.amin(dim=0) + points.amax(dim=0)) / 2
        return float((100 / ((eyes - centre) * toward).sum(dim=1)).mean())

    target, distance = aim_to_fit(toward, points, **view)
    best = size(target, distance)
    box = (points.amin(dim=0) + points.amax(dim=0)) / 2
    assert best > 1.05 * size(box, distance_to_fit(toward, points, box, **view))
    for shift in torch.randn(20, 3, generator=generator, dtype=torch.float64) * 0.1:
        rival = distance_to_fit(toward, points, target + shift, **view)
        assert size(target + shift, rival) < 1.002 * best


@pytest.mark.parametrize(("up", "axis"), [("x", 0), ("y", 1), ("z", 2)])
def test_the_axis_given_as_up_is_vertical(egg, up, axis):
    scene = build_scene(egg, SceneConfig(num_views=2, width=40, height=30, up=up))
    extent = scene.object_mesh.vertices_world
    low, high = extent.amin(dim=0), extent.amax(dim=0)
    size = high - low
    assert abs(float(low[2])) < 1e-9
    assert_close(low[:2], -high[:2])
    assert_close(size.amax(), torch.tensor(2.4, dtype=torch.float64))
    assert (size[2] > 2.3) == (axis == 1)
    volume = torch.linalg.det(extent[scene.object_mesh.faces]).sum()
    assert volume > 0  # not mirrored


def test_a_mesh_with_colours_keeps_them(tmp_path, generator):
    vertices, faces = icosphere(1)
    albedo = torch.rand(len(vertices), 3, generator=generator, dtype=torch.float64)
    albedo[0] = 1
    mesh = Mesh(vertices_world=vertices, faces=faces, albedo=albedo)
    write_ply(mesh, tmp_path / "painted.ply")
    found = build_scene(tmp_path / "painted.ply", SMALL).object_mesh.albedo
    # Up to the scale that maps the brightest to 255, which clips a few.
    scale = (found / albedo).median()
    assert ((found / albedo - scale).abs() < 0.05 * scale).float().mean() > 0.9


def test_gloss_is_that_of_the_scene_unless_given(egg):
    assert build_scene(egg, SMALL).objects[0].specular == 0
    glossy = SceneConfig(num_views=2, width=40, height=30, specular=0.1, roughness=0.5)
    scene = build_scene(egg, glossy)
    assert (scene.objects[0].specular, scene.objects[0].roughness) == (0.1, 0.5)
    assert scene.objects[-1].specular == 0  # the table remains matte


def test_a_uniform_albedo_replaces_only_the_texture_of_the_object(egg):
    options = {"num_views": 2, "width": 40, "height": 30}
    plain = build_scene(egg, SceneConfig(albedo=(0.6, 0.5, 0.4), **options))
    textured = build_scene(egg, SceneConfig(**options))
    expected = torch.tensor([0.6, 0.5, 0.4]).expand_as(plain.object_mesh.albedo)
    assert_close(plain.object_mesh.albedo, expected)
    assert textured.object_mesh.albedo.std() > 0.05
    assert_close(plain.surroundings_mesh.albedo, textured.surroundings_mesh.albedo)
    assert_close(plain.lights.positions_world, textured.lights.positions_world)


def test_a_patterned_table_has_more_contrast_than_a_cloth_and_a_plain_one_has_none(egg):
    def contrast(table):
        scene = build_scene(egg, SceneConfig(num_views=2, width=40, height=30, table=table))
        albedo = scene.surroundings_mesh.albedo
        return float((albedo.std(dim=0) / albedo.mean(dim=0)).min())

    assert contrast("patterned") > 2 * contrast("cloth") > contrast("plain") == 0


def test_an_object_turns_counter_clockwise_with_its_texture(egg):
    options = {"num_views": 2, "width": 40, "height": 30}
    still = build_scene(egg, SceneConfig(**options)).object_mesh
    rotated = build_scene(egg, SceneConfig(rotation_deg=90.0, **options)).object_mesh
    quarter = still.vertices_world.new_tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # x to y
    assert_close(rotated.vertices_world, still.vertices_world @ quarter.mT)
    assert_close(rotated.normals_world.double(), still.normals_world.double() @ quarter.mT)
    assert_close(rotated.albedo, still.albedo, atol=1e-4, rtol=0)  # the texture is float32


def test_normals_that_contradict_their_faces_are_ignored(tmp_path):
    # A regular octahedron with one normal per face, as for flat shading.
    corners = "v 1 0 0\nv -1 0 0\nv 0 1 0\nv 0 -1 0\nv 0 0 1\nv 0 0 -1\n"
    flat = "".join(f"vn {x} {y} {z}\n" for x in (1, -1) for y in (1, -1) for z in (1, -1))
    order = [(1, 3, 5), (1, 6, 3), (1, 5, 4), (1, 4, 6), (2, 5, 3), (2, 3, 6), (2, 4, 5), (2, 6, 4)]
    faces = "".join(
        "f " + " ".join(f"{corner}//{face + 1}" for corner in one) + "\n"
        for face, one in enumerate(order)
    )
    (tmp_path / "flat.obj").write_text(corners + flat + faces)
    mesh = build_scene(tmp_path / "flat.obj", SMALL).object_mesh
    centre = mesh.vertices_world.mean(dim=0)
    radial = torch.nn.functional.normalize(mesh.vertices_world - centre, dim=1)
    assert_close(mesh.normals_world, radial.float(), atol=1e-5, rtol=0)


def test_the_front_object_of_a_pair_occludes_part_of_the_other(generator):
    scene = build_scene("pair", SceneConfig(num_views=5, width=80, height=60))
    behind, front = (TracedObjects([item]) for item in scene.objects[:2])
    gap = KDTree(scene.objects[0].mesh.vertices_world.numpy()).query(
        scene.objects[1].mesh.vertices_world.numpy()
    )[0]
    assert gap.min() > 0.15
    for view in range(5):
        camera = scene.cameras
        pixels = pixel_centers(80, 60, like=camera.intrinsics).reshape(-1, 2)
        rays = rays_through(pixels, camera.cam_from_world[view], camera.intrinsics[view]).float()
        eye = camera.centers_world[view].float()
        hidden = (behind.trace(eye, rays).object_index >= 0) & (
            front.trace(eye, rays).object_index >= 0
        )
        assert hidden.sum() > 20


def test_the_seed_determines_the_scene(egg):
    first, again = build_scene(egg, SMALL), build_scene(egg, SMALL)
    other = build_scene(egg, SceneConfig(num_views=5, width=80, height=60, seed=1))
    assert_close(first.lights.positions_world, again.lights.positions_world)
    assert_close(first.object_mesh.albedo, again.object_mesh.albedo)
    assert (first.lights.positions_world - other.lights.positions_world).norm(dim=1).min() > 0.01
    assert (first.object_mesh.albedo - other.object_mesh.albedo).abs().mean() > 0.05
    draws = {float(torch.rand(1, generator=first.noise(view))) for view in range(5)}
    assert len(draws) == 5


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("jug", r"'jug' is neither a scene.*mug, jar, balls, potatoes"),
        ("cloud.ply", "without faces"),
    ],
)
def test_an_invalid_object_is_refused(tmp_path, monkeypatch, name, words):
    monkeypatch.chdir(tmp_path)
    points = ball(level=1)
    write_ply(points.replace(faces=points.faces[:0]), tmp_path / "cloud.ply")
    with pytest.raises(InputError, match=words):
        build_scene(name, SMALL)


BEFORE = ("fixed_point_light", "fixed_room", "fixed_table")


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ({"num_views": 0}, "num_views is 0"),
        ({"num_views": 8, "lights_per_pose": 3}, "lights_per_pose is 3"),
        ({"num_views": 8, "lights_per_pose": 2, "crop_jitter_px": 1.0}, "lights_per_pose is 2"),
        ({"elevation_deg": 3.0}, "elevation_deg is 3.0"),
        ({"irradiance": 0.0, "ambient": 0.0}, "light from irradiance"),
        ({"point_light_distance": 0.5}, "point_light_distance is 0.5"),
        ({"exposure": 0.0}, "exposure is 0.0"),
        ({"supersample": 0}, "supersample is 0"),
        ({"albedo": (0.5, 0.5, 1.5)}, "albedo is"),
        *(({name: True}, f"{name} is True.*turntable instead of arc") for name in BEFORE),
        (
            {"path": "turntable", "constant_light": True, "fixed_point_light": True},
            r"constant_light is True.*no fixed_point_light",
        ),
        (
            {"path": "turntable", "turned_over": True, "fixed_room": True},
            "turned_over is True; needed: at least 2 views",
        ),
        (
            {"width": 80, "height": 60, "pan_jitter_px": 9.0, "crop_jitter_px": 10.0},
            r"pan_jitter_px is 9.*at most 18",
        ),
    ],
)
def test_settings_without_photographs_are_refused(setting, words):
    with pytest.raises(ConfigError, match=words):
        SceneConfig(**setting)


def test_point_lights_stay_above_the_table_on_the_photographed_side(generator):
    azimuths = torch.linspace(0, 5, 12, dtype=torch.float64)
    target = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    lights = lights_round(
        azimuths, generator, distance=5.0, target=target, irradiance=1.0, ambient=0.1
    )
    toward = lights.positions_world - target
    distance = toward.norm(dim=1)
    assert ((distance > 3.7) & (distance < 6.3)).all()
    elevation = torch.rad2deg(torch.asin(toward[:, 2] / distance))
    assert ((elevation > 18 - 1e-6) & (elevation < 72 + 1e-6)).all()
    assert elevation.max() - elevation.min() > 30
    facing = toward[:, 0] * azimuths.sin() - toward[:, 1] * azimuths.cos()
    assert (facing > 0).all()


def test_distant_light_does_not_fall_off(generator):
    target = torch.zeros(3, dtype=torch.float64)
    azimuths = torch.zeros(1, dtype=torch.float64)
    lights = lights_round(
        azimuths, generator, distance=5.0, target=target, irradiance=1.0, ambient=0.1, far=True
    )
    point_light = lights.point_light(0).replace(irradiance=1.0)
    points = torch.tensor([[1.0, 1, 1], [-1, -1, -1]])
    toward, arriving = point_light.arriving(points)
    assert_close(toward[0], toward[1], atol=1e-5, rtol=0)
    assert_close(arriving, torch.ones(2), atol=1e-4, rtol=0)


def test_handheld_cameras_are_all_around_at_three_heights(generator):
    toward = handheld_directions(24, generator, elevation_deg=30.0)
    azimuth = torch.rad2deg(torch.atan2(toward[:, 0], -toward[:, 1])) % 360
    gaps = azimuth.sort().values.diff()
    assert gaps.max() < 60
    assert gaps.std() > 1  # irregular
    heights = torch.rad2deg(torch.asin(toward[:, 2])).reshape(3, 8).mean(dim=1)
    assert heights[1] > heights[0] + 10
    assert heights[2] < heights[0] - 6


def test_paint_replaces_albedo_and_marks_darken_it():
    points = torch.tensor([[0.0, -1.0, 0.5], [0.0, 1.0, 0.5], [0.0, -1.0, 2.0]])

    def white(at):
        return torch.ones_like(at)

    def gray(at):
        return torch.full_like(at, 0.25)

    front = painted(white, gray, radii=(0.5, 1.5), heights=(0.0, 1.0), azimuths_deg=(-30.0, 30.0))
    assert front(points)[:, 0].tolist() == [0.25, 1.0, 1.0]
    assert marked(front, gray)(points)[:, 0].tolist() == [0.0625, 0.25, 0.25]


@pytest.mark.parametrize("name", scene_objects.RECIPES)
def test_every_object_is_on_the_table_at_its_centre(name, monkeypatch, generator):
    monkeypatch.setattr(scene_objects, "mug_mesh", lambda: _MUG_MESH(cell=0.06))
    made = scene_objects.RECIPES[name](generator)
    points = torch.cat([item.mesh.vertices_world for item in made])
    assert abs(float(points[:, 2].min())) < 0.01
    size = points.amax(dim=0) - points.amin(dim=0)
    assert 1.8 < float(size.amax()) < 3.2
    assert (points[:, :2].amax(dim=0) + points[:, :2].amin(dim=0)).abs().max() < 0.8
    for item in made:
        shade = item.texture(item.mesh.vertices_world[::50].float())
        assert ((shade > 0) & (shade < 1)).all()


_MUG_MESH = scene_objects.mug_mesh


def test_balls_do_not_intersect():
    made = scene_objects.balls(torch.Generator().manual_seed(1))
    corners = [item.mesh.vertices_world for item in made]
    centres = torch.stack([vertices.mean(dim=0) for vertices in corners])
    radii = (torch.stack([vertices[0] for vertices in corners]) - centres).norm(dim=1)
    gaps = torch.cdist(centres, centres) - radii - radii[:, None]
    assert gaps[~torch.eye(len(made), dtype=torch.bool)].min() > -1e-3


def test_potatoes_do_not_intersect():
    meshes = [item.mesh for item in scene_objects.potatoes(torch.Generator().manual_seed(0))]
    nearest = []
    for first in range(4):
        for second in range(first):
            one, other = (meshes[index].vertices_world for index in (first, second))
            near, which = KDTree(other.numpy()).query(one.numpy()[::10])
            outward = meshes[second].normals_world[which]
            beyond = ((one[::10] - other[which]) * outward).sum(dim=1)
            assert beyond[near < 0.05].numel() == 0 or beyond[near < 0.05].min() > -0.02
            nearest.append(near.min())
    assert len([gap for gap in nearest if gap < 0.05]) >= 3  # a pile, not a row
