"""An untextured ball seen from an arc of views, and the surface of its visual hull."""

import pytest
import torch
from scenes import ball, trusted
from skimage.measure import marching_cubes

from pimper_bench.scenes.render_in_memory import Sphere, render_shape
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_bench.scenes.scene_lights import wandering_lights
from pimper_bench.scenes.true_clouds import sparse_scene
from pimper_torch.geometry.contours import Contours
from pimper_torch.lighting.light_field import LightField
from pimper_torch.records import Mesh, Silhouettes
from pimper_torch.stages.light_depth.depth_from_light import DepthFromLight
from pimper_torch.stages.silhouettes.trace import TraceContours

VIEWS = 16


def scene_of(num_views=VIEWS, texture=None):
    """Return the scene of a ball of radius 1, the contours of its silhouettes, and its light."""
    generator = torch.Generator().manual_seed(3)
    cameras = arc_cameras(
        num_views, width=120, height=90, focal_px=112.5, distance=3.0, span_deg=50.0
    )
    lights = wandering_lights(num_views, generator, distance=8.0, spread_deg=35.0)
    white = texture or (lambda points: torch.full_like(points, 0.6))
    rendered = render_shape(Sphere(), cameras, lights.harmonics_world(), white)
    scene = sparse_scene(rendered, 20, generator, dtype=torch.float64)
    silhouettes = trusted(rendered.depth.isfinite().double())
    contours = TraceContours()(silhouettes, scene.cameras)
    ambient, lamp = lights.harmonics_world().split([1, 3], dim=1)
    field = LightField(
        origin=torch.zeros(3).double(),
        soft=torch.nn.functional.pad(ambient, (0, 8)),
        point_light=lamp,
        inverse_distance=torch.zeros(num_views).double(),
    )
    return scene, contours, field


@pytest.fixture(scope="module")
def arc():
    return scene_of()


def surface_of(contours):
    """Return the surface of the visual hull."""
    hull = contours.hull
    distance = torch.nn.functional.pad(hull.distance, (1,) * 6, value=-float(hull.spacing))
    vertices, faces, _, _ = marching_cubes(distance.clamp(-1, 1).numpy(), 0.0)
    step = float(hull.spacing)
    world = hull.origin_world + step * (torch.from_numpy(vertices.copy()) - 1)
    return Mesh(vertices_world=world.double(), faces=torch.from_numpy(faces.copy()).long())


def off(cloud):
    """Return distances to the ball, and angles between the normals and those of the ball."""
    radius = cloud.points_world.norm(dim=1)
    cosine = (cloud.points_world * cloud.normals_world).sum(dim=1) / radius
    return (radius - 1).abs(), torch.rad2deg(cosine.clamp(-1, 1).acos())


def test_the_ball_is_recovered_inside_its_hull(arc):
    scene, contours, field = arc
    hull = surface_of(contours)
    # From an arc of views, the hull is far from the ball.
    assert (hull.vertices_world.norm(dim=1) - 1).abs().median() > 0.02
    cloud = DepthFromLight()(scene, contours, hull, field)
    distance, angle = off(cloud)
    assert len(distance) > 500
    assert distance.median() < 0.02  # 1 % of its diameter
    assert angle.median() < 3
    assert (cloud.noise > 0).all()
    assert cloud.points_world.dtype == torch.float64


def test_rotated_lights_do_not_bias_depths(arc):
    scene, contours, field = arc
    turn = torch.matrix_exp(torch.tensor([[0, 0, 0.35], [0, 0, 0], [-0.35, 0, 0]]).double())
    turned = field.replace(point_light=field.point_light @ turn.mT)
    cloud = DepthFromLight()(scene, contours, surface_of(contours), turned)
    distance, angle = off(cloud)
    assert distance.median() < 0.02
    assert angle.median() < 8  # of 20 degrees


def test_a_correct_surface_yields_no_points(arc):
    scene, contours, field = arc
    cloud = DepthFromLight()(scene, contours, ball(level=5).to(torch.float64), field)
    assert len(cloud.points_world) == 0


def test_soft_light_yields_no_points(arc):
    scene, contours, field = arc
    soft = torch.cat([field.soft[:, :1], field.point_light, field.soft[:, 4:]], dim=1)
    soft = field.replace(soft=soft, point_light=torch.zeros_like(field.point_light))
    assert len(DepthFromLight()(scene, contours, surface_of(contours), soft).points_world) == 0


def test_parallel_lights_of_any_strength_yield_finite_points(arc):
    scene, contours, field = arc
    same = 1e6 * field.point_light[:1].expand_as(field.point_light)
    scene, field = scene.to(torch.float32), field.replace(point_light=same).to(torch.float32)
    hull = surface_of(contours)
    mesh = hull.replace(vertices_world=hull.vertices_world.float())
    cloud = DepthFromLight()(scene, contours, mesh, field)
    assert cloud.points_world.isfinite().all()
    assert cloud.normals_world.isfinite().all()


def test_few_views_or_full_silhouettes_yield_no_points(arc):
    scene, contours, field = scene_of(num_views=7)
    hull = surface_of(contours)
    assert len(DepthFromLight()(scene, contours, hull, field).points_world) == 0
    scene, contours, field = arc
    everything = Contours.none(Silhouettes.everything(scene.views), scene.cameras)
    found = DepthFromLight()(scene, everything, surface_of(contours), field)
    assert len(found.points_world) == 0


def test_unshaded_photographs_yield_no_points(arc):
    scene, contours, field = arc
    even = scene.views.replace(images=torch.full_like(scene.views.images, 0.3))
    found = DepthFromLight()(scene.replace(views=even), contours, surface_of(contours), field)
    assert len(found.points_world) == 0
