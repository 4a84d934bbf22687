import torch
from torch.testing import assert_close

from pimper_torch.evidence.scenes.interreflection import Interreflection, transfer
from pimper_torch.evidence.scenes.lights import PointLight
from pimper_torch.evidence.scenes.meshes import icosphere, table
from pimper_torch.evidence.scenes.scene_object import SceneObject
from pimper_torch.evidence.scenes.stage import Stage
from pimper_torch.records import Mesh

AT_CENTER = PointLight(
    position=torch.zeros(3),
    target=torch.tensor([0.0, 0, 1]),
    irradiance=0.5,
    ambient=0.3,
    flash=0.0,
)


def gray(points):
    return torch.full_like(points, 0.6)


def test_a_point_light_in_a_hollow_ball_is_seen_in_every_bounce_by_its_albedo():
    vertices, faces = icosphere(3)
    stage = Stage(
        [SceneObject(mesh=Mesh(vertices_world=vertices, faces=faces.flip(1)), texture=gray)]
    )
    once = Interreflection(stage, 1, num_rays=16).light(stage, AT_CENTER)
    # Everything receives 0.5, and all that anything sees sends 0.6 of it.
    # Facets bulge less than the ball: their centres are up to 1 % nearer to the point light.
    assert_close(once, torch.full_like(once, 0.6 * 0.5), rtol=0.03, atol=0)
    thrice = Interreflection(stage, 3, num_rays=16).light(stage, AT_CENTER)
    expected = 0.5 * (0.6 + 0.6**2 + 0.6**3)
    assert_close(thrice, torch.full_like(thrice, expected), rtol=0.03, atol=0)


def test_the_share_of_a_ball_over_a_table_has_its_closed_form():
    radius, height = 0.5, 1.0
    vertices, faces = icosphere(3)
    ball = Mesh(vertices_world=radius * vertices + vertices.new_tensor([0, 0, height]), faces=faces)
    stage = Stage(
        [SceneObject(mesh=table(1.0, cells=2), texture=gray), SceneObject(mesh=ball, texture=gray)]
    )
    fraction = transfer(stage, 1024, seed=0)
    centre, corner = float(fraction[[4]].sum()), float(fraction[[0]].sum())
    # Howell's catalogue: (r / h)^2 below the ball, times the cube of the cosine aside, here
    # with distance^2 = 1 + 1 + 1.
    assert abs(centre - radius**2 / height**2) < 0.01
    assert abs(corner - radius**2 * height / 3**1.5) < 0.01


def test_a_lone_table_gets_no_light_from_others():
    stage = Stage([SceneObject(mesh=table(1.0, cells=4), texture=gray)])
    point_light = AT_CENTER.replace(position=torch.tensor([0.0, 0, 2]))
    assert (Interreflection(stage, 2).light(stage, point_light) == 0).all()
