import math

import pytest
import torch
from torch.nn.functional import normalize

from pimper_bench.scenes.procedural_meshes import icosphere, join, moved, table
from pimper_torch.geometry.pinholes import look_at, pinholes
from pimper_torch.io.tensors import scene_of
from pimper_torch.records import Mesh, ViewLights
from pimper_torch.stages.relighting.fit_lights import lights_of, observe_all
from pimper_torch.stages.relighting.held_out import predict
from pimper_torch.stages.relighting.lit_surface import LitSurface
from tests.relighting.ball import ball_mesh, photographed

MATTE, GLOSSY = (0.0, 1.0, 0.0), (0.0, 0.3, 1.0)


def fit_lights(mesh, scene):
    surface = LitSurface(mesh)
    return lights_of(surface, observe_all(surface, scene, None))


def angles_deg(one, other):
    return (one * other).sum(dim=1).clamp(-1, 1).acos().rad2deg()


@pytest.fixture(scope="module")
def ball():
    return ball_mesh()


def test_the_light_of_a_matte_ball_is_estimated(ball):
    scene, lights = photographed(MATTE)
    found = fit_lights(ball, scene)
    assert angles_deg(found.direction_world, lights.direction_world).max() < 0.5
    assert torch.allclose(found.ambient, lights.ambient, atol=0.01)
    assert torch.allclose(found.directed, lights.directed, atol=0.02)


def test_highlights_hardly_move_a_light(ball):
    scene, lights = photographed(GLOSSY)
    found = fit_lights(ball, scene)
    assert angles_deg(found.direction_world, lights.direction_world).max() < 2


def test_a_photograph_without_the_object_gets_no_light(ball):
    scene, _ = photographed(MATTE, views=3)
    empty = torch.zeros_like(scene.views.images[:, 0], dtype=torch.bool)
    scene = scene.replace(views=scene.views.replace(masks=empty))
    found = fit_lights(ball, scene)
    assert not found.ambient.any()
    assert not found.directed.any()
    assert torch.allclose(found.direction_world.norm(dim=1), torch.ones(3))


@pytest.fixture(scope="module")
def ball_over_table():
    vertices, faces = icosphere(4)
    ball = moved(
        Mesh(vertices_world=vertices, faces=faces, normals_world=vertices),
        scale=0.5,
        shift=(0.0, 0.0, 1.2),
    )
    mesh = join(ball, table(3.0)).to(torch.float32)
    return mesh.replace(albedo=torch.full_like(mesh.vertices_world, 0.5))


@pytest.fixture(scope="module")
def camera():
    """From above."""
    eye = torch.tensor([[0.0, -4, 6]])
    pose = look_at(eye, torch.zeros(3), torch.tensor([0.0, 0, 1]))
    return pinholes(pose, 200.0, 160, 120)


@pytest.fixture(scope="module")
def light():
    return ViewLights(
        direction_world=normalize(torch.tensor([[0.5, 0.2, 0.9]]), dim=1),
        ambient=torch.full((1, 3), 0.1),
        inverse_distance=torch.zeros(1),
        directed=torch.full((1, 3), 0.8),
    )


def test_cast_shadows_follow_the_geometry(ball_over_table, camera, light):
    surface, direction = LitSurface(ball_over_table), light.direction_world
    picture = predict(surface, camera, light)
    pixels = surface.pixels(camera)
    on_table = pixels.points_world[:, 2] < 1e-3
    points = pixels.points_world[on_table]
    centre = torch.tensor([0.0, 0, 1.2]) - points
    apart = (centre - (centre @ direction[0])[:, None] * direction).norm(dim=1)
    shade = picture.reshape(-1, 3)[pixels.pixel[on_table], 0]
    dark, bright = 0.9 * 0.1, 0.9 * (0.1 + 0.8 * float(direction[0, 2]))
    assert torch.allclose(shade[apart < 0.48], torch.tensor(dark), atol=1e-4)
    assert torch.allclose(shade[apart > 0.52], torch.tensor(bright), atol=1e-4)
    assert (apart < 0.48).sum() > 100


def test_cast_shadows_determine_a_light_that_shading_does_not(ball_over_table, camera, light):
    """All lights at one angle to its normal light a plane equally."""
    picture = predict(ball_over_table, camera, light).nan_to_num(0)
    scene = scene_of(picture.movedim(-1, 0)[None], camera.intrinsics, camera.cam_from_world)
    found = fit_lights(ball_over_table, scene)
    # A pixel is at least 0.036 wide on the table, and the ball's centre 1.4 from its shadow.
    half_a_pixel_deg = math.degrees(0.018 / 1.4)
    assert angles_deg(found.direction_world, light.direction_world).max() < half_a_pixel_deg
