import torch
from scenes import ball
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import potato, table
from pimper_bench.scenes.render_in_memory import (
    Sphere,
    render_objects,
    render_shape,
)
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_bench.scenes.scene_lights import Lights, wandering_lights
from pimper_bench.scenes.scene_object import SceneObject
from pimper_bench.scenes.scene_settings import SensorConfig
from pimper_bench.scenes.textures import random_speckle
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import project, rays_through
from pimper_torch.geometry.topology import half_edges

QUIET = SensorConfig(supersample=1, read_noise=0.0, shot_noise=0.0)


def white(points):
    return torch.ones_like(points)


def point_light(position, **changes):
    settings = {
        "positions_world": torch.tensor([position], dtype=torch.float64),
        "irradiance": torch.tensor([1.0], dtype=torch.float64),
        "ambient": torch.tensor([0.0], dtype=torch.float64),
        "target_world": torch.zeros(3, dtype=torch.float64),
    }
    return Lights(**(settings | changes))


def above(width=31, height=31):
    return arc_cameras(1, width=width, height=height, focal_px=60.0, distance=5.0, span_deg=0.0)


def test_closed_forms_obey_first_order_lighting_exactly(cameras, generator):
    lights = torch.rand(3, 4, generator=generator, dtype=torch.float64)
    scene = render_shape(Sphere(), cameras, lights, random_speckle(generator))
    harmonics = torch.cat([torch.ones_like(scene.depth)[..., None], scene.normals_world], dim=-1)
    shading = torch.einsum("vhwc,vc->vhw", harmonics, lights)
    expected = (scene.albedo * shading.clamp_min(0)[..., None]).movedim(-1, 1)
    assert_close(scene.views.images, expected.float(), atol=1e-6, rtol=0)
    assert scene.lit.any()
    assert_close(scene.lit, scene.foreground & (shading > 0))
    assert scene.views.images.std() > 0.1


def test_depth_times_ray_is_the_surface_in_closed_forms(cameras):
    lights = torch.zeros(3, 4, dtype=torch.float64)
    scene = render_shape(Sphere(radius=0.9), cameras, lights, white)
    pixels = pixel_centers(40, 30, like=cameras.intrinsics).reshape(-1, 2)
    for view in range(3):
        rays = rays_through(pixels, cameras.cam_from_world[view], cameras.intrinsics[view])
        depth = scene.depth[view].reshape(-1)
        hit = depth.isfinite()
        points = (cameras.centers_world[view] + depth[:, None] * rays)[hit]
        assert_close(points.norm(dim=1), torch.full((len(points),), 0.9, dtype=torch.float64))
        assert_close(points / 0.9, scene.normals_world[view].reshape(-1, 3)[hit])
        found, along = project(points, cameras.cam_from_world[view], cameras.intrinsics[view])
        assert_close(found, pixels[hit])
        assert_close(along, depth[hit])


def photographed(*objects, lights, sensor=QUIET):
    """Render objects from above, by default white matte ones."""
    items = [
        one if isinstance(one, SceneObject) else SceneObject(mesh=one, texture=white)
        for one in objects
    ]
    generator = torch.Generator().manual_seed(62)
    return render_objects(items, above(), lights, generator, sensor)


def test_a_lit_table_has_the_stated_irradiance_and_falloff():
    image = photographed(table(2.0), lights=point_light([0.0, 0.0, 2.0])).views.images[0, 0]
    assert_close(image[15, 15], torch.tensor(1.0), atol=1e-4, rtol=0)
    # A pixel is 5/60 wide on the table; 12 pixels from the centre, x = 1 and
    # cos / d^2 = (2 / d) (2 / d)^2.
    distance = (1 + 4) ** 0.5
    assert_close(image[15, 27], torch.tensor((2 / distance) ** 3), atol=1e-4, rtol=0)


def test_the_shadow_of_a_ball_follows_from_similar_triangles():
    above_table = SceneObject(mesh=ball(0.3, 4, (1.0, 0.0, 1.0)), texture=white, surroundings=True)
    # From (2, 0, 2) through the ball's centre (1, 0, 1) light would come to the origin.
    lights = point_light([2.0, 0.0, 2.0], ambient=torch.tensor([0.1]).double())
    scene = photographed(table(3.0), above_table, lights=lights)
    assert not scene.lit[0, 15, 15]
    assert_close(scene.views.images[0, 0, 15, 15], torch.tensor(0.1), atol=1e-6, rtol=0)
    # The cone's half angle is asin(0.3 / sqrt 2), so the shadow ends at x = -1.108; columns 3
    # and 1 see x = -1 and x = -1.167.
    assert not scene.lit[0, 15, 3]
    assert scene.lit[0, 15, 1]
    assert scene.lit[0, 27, 15]
    assert scene.foreground[0, 15, 15]
    assert not scene.foreground[0, 15, 30]  # the ball is in front of the table there


def test_a_window_lights_by_its_closed_form_and_the_lamp_has_its_colour():
    lights = point_light(
        [0.0, 0.0, 2.0],
        irradiance=torch.tensor([0.2]).double(),
        window=torch.tensor([0.3, 0.0, 0.4]).double(),
        colour=torch.tensor([[1.2, 1.0, 0.8]]).double(),
    )
    scene = photographed(table(2.0), lights=lights)
    soft = 0.5 * ((1 + 0.8) / 2) ** 2
    expected = torch.tensor([0.24, 0.2, 0.16]) + soft
    assert_close(scene.views.images[0, :, 15, 15], expected, atol=1e-4, rtol=0)


def test_gloss_adds_a_highlight_in_the_mirror_direction():
    glossy = SceneObject(mesh=table(3.0), texture=white, specular=0.04, roughness=0.3)
    lights = point_light([2.0, 0.0, 5.0], irradiance=torch.tensor([0.1]).double())
    matte, shiny = (
        photographed(item, lights=lights).views.images[0, 0] for item in (table(3.0), glossy)
    )
    extra = shiny - matte
    assert (extra >= -0.012).all()  # specular light is subtracted from the diffuse part
    # Camera and point light are 5 above x = 0 and x = 2: the mirror point is x = 1, pixel 12.
    row, column = divmod(int(extra.argmax()), 31)
    assert row == 15
    assert abs(column - 27) <= 1


def test_a_ray_traced_ball_agrees_with_its_closed_form():
    cameras = arc_cameras(2, width=40, height=30, focal_px=50.0, distance=4.0)
    generator = torch.Generator().manual_seed(67)
    far = Lights(
        positions_world=torch.tensor([[3e3, 0.0, 4e3], [0.0, 3e3, 4e3]], dtype=torch.float64),
        irradiance=torch.full((2,), 0.7, dtype=torch.float64),
        ambient=torch.full((2,), 0.1, dtype=torch.float64),
        target_world=torch.zeros(3, dtype=torch.float64),
    )
    texture = random_speckle(generator, cells=(0.5,))
    item = SceneObject(mesh=ball(level=6), texture=texture)
    traced = render_objects([item], cameras, far, generator, QUIET)
    closed = render_shape(Sphere(), cameras, traced.lights_world, texture)
    both = traced.foreground & closed.lit & traced.lit
    assert both.float().mean() > 0.1
    gap = (traced.views.images - closed.views.images).abs().amax(dim=1)[both]
    assert gap.max() < 0.03  # facets of 1/60 tilt the surface by as much at the rim
    assert gap.mean() < 0.002
    depth = (traced.depth - closed.depth).abs()[both]
    assert depth.mean() < 1e-3
    normals = (traced.normals_world - closed.normals_world).norm(dim=-1)[both]
    assert normals.mean() < 2e-3


def test_noise_and_saturation_follow_the_sensor():
    noisy = SensorConfig(supersample=1, read_noise=0.01, shot_noise=0.0)
    dim, bright = (
        point_light([0.0, 0.0, 50.0], irradiance=torch.tensor([strength]).double())
        for strength in (0.5, 5.0)
    )
    images, again = (
        photographed(table(3.0), lights=dim, sensor=noisy).views.images for _ in range(2)
    )
    assert abs(images.std() - 0.01) < 0.001
    assert torch.equal(again, images)
    assert (photographed(table(3.0), lights=bright, sensor=noisy).views.images == 1).all()


def test_a_pixel_integrates_over_its_area():
    def halves(points):  # black and white meet at x = 0, the centre of the centre pixel
        return (points[..., :1] > 0).to(points).expand_as(points)

    lights = point_light([0.0, 0.0, 50.0], irradiance=torch.tensor([0.8]).double())
    sensor = SensorConfig(supersample=4, read_noise=0.0, shot_noise=0.0)
    item = SceneObject(mesh=table(3.0), texture=halves)
    image = photographed(item, lights=lights, sensor=sensor).views.images[0, 0, 15]
    assert_close(image[15], torch.tensor(0.4), atol=2e-3, rtol=0)
    assert image[14] == 0
    assert_close(image[16], torch.tensor(0.8), atol=2e-3, rtol=0)


def test_point_lights_stay_within_their_cone_and_differ(generator):
    lights = wandering_lights(12, generator, distance=4.0, toward=(0.0, -1.0, 1.0))
    toward = lights.positions_world / lights.positions_world.norm(dim=1, keepdim=True)
    axis = torch.tensor([0.0, -(0.5**0.5), 0.5**0.5], dtype=torch.float64)
    tilt = torch.rad2deg(torch.acos(toward @ axis))
    assert (tilt > 15 - 1e-6).all()
    assert (tilt < 65 + 1e-6).all()
    assert torch.linalg.svdvals(lights.harmonics_world())[3] > 0.05  # four independent lights
    distance = lights.positions_world.norm(dim=1)
    assert (distance >= 3).all()
    assert (distance <= 5).all()


def test_a_potato_is_closed_on_the_table_and_depends_only_on_its_seed():
    first = potato(torch.Generator().manual_seed(70), subdivisions=3)
    assert_close(first.vertices_world[:, 2].min(), torch.tensor(0.0, dtype=torch.float64))
    edges = half_edges(first.faces).sort(dim=1).values
    assert (torch.unique(edges, dim=0, return_counts=True)[1] == 2).all()
    centre = first.vertices_world.mean(dim=0)
    outward = ((first.vertices_world - centre) * first.normals_world).sum(dim=1)
    assert (outward > 0).all()
    again = potato(torch.Generator().manual_seed(70), subdivisions=3)
    assert_close(first.vertices_world, again.vertices_world)
    other = potato(torch.Generator().manual_seed(71), subdivisions=3)
    assert (first.vertices_world - other.vertices_world).norm(dim=1).mean() > 0.01
