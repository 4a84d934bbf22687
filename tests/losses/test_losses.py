"""Losses of a sphere under known lights, in closed form, and their gradients."""

import math

import pytest
import torch
import trimesh
from surfaces import surface_of
from torch.testing import assert_close

import pimper_torch as pt
from pimper_bench.scenes import render_shape, sparse_scene
from pimper_bench.scenes.render_in_memory import Sphere
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_bench.scenes.scene_lights import wandering_lights
from pimper_torch.geometry.visibility import cast_view, visible_vertices


@pytest.fixture(scope="module")
def scene():
    generator = torch.Generator().manual_seed(3)
    cameras = arc_cameras(5, width=160, height=120, focal_px=180.0, distance=4.0, span_deg=40.0)
    lights = wandering_lights(5, generator, distance=5.0, spread_deg=35.0, irradiance=0.6)
    rendered = render_shape(Sphere(), cameras, lights.harmonics_world(), torch.ones_like)
    return sparse_scene(rendered, 40, generator, dtype=torch.float64)


@pytest.fixture(scope="module")
def ball():
    mesh = trimesh.creation.icosphere(subdivisions=4)
    vertices = torch.from_numpy(mesh.vertices.copy())
    faces = torch.from_numpy(mesh.faces.copy())
    return surface_of(vertices, faces, normals_world=vertices / vertices.norm(dim=1, keepdim=True))


def slope(function, value, direction, step=1e-6):
    """Return the directional derivative by autograd, and by central differences."""
    value = value.detach().requires_grad_()
    (gradient,) = torch.autograd.grad(function(value), value)
    ahead, behind = (function((value + s * step * direction).detach()) for s in (1, -1))
    return (gradient * direction).sum(), (ahead - behind) / (2 * step)


def moved(ball, offset):
    return ball.replace(vertices_world=ball.vertices_world + offset)


def test_a_true_surface_predicts_the_photographs(scene, ball):
    loss = pt.losses.PhotometricLoss()
    visible = loss.visible(ball, scene)
    assert visible.sum(dim=1).min() > 250
    assert loss(ball, scene, visible) < 1e-5
    assert all(error.abs().max() < 0.05 for error in loss.errors(ball, scene, visible))
    dark = scene.replace(views=scene.views.replace(images=0.3 * scene.views.images))
    assert_close(loss(ball, dark, visible), loss(ball, scene, visible))
    tilted = torch.nn.functional.normalize(
        ball.normals_world + 0.3 * ball.vertices_world.flip(1), dim=1
    )
    assert loss(ball.replace(normals_world=tilted), scene, visible) > 1e-3


def test_shadows_and_occluded_vertices_do_not_count(scene, ball):
    visible = visible_vertices(ball.mesh, scene.cameras)
    center = scene.cameras.centers_world[0]
    beyond = (ball.vertices_world * center).sum(dim=1) < 1.0  # behind the horizon of the sphere
    assert not visible[0, beyond].any()
    darkest = pt.losses.PhotometricLoss(darkest=0.9)
    assert darkest.visible(ball, scene).sum() < 0.5 * visible.sum()


def test_photographs_with_too_few_visible_vertices_do_not_count(scene, ball):
    loss = pt.losses.PhotometricLoss()
    visible = loss.visible(ball, scene)
    alone = loss(ball, scene, visible & (torch.arange(5) == 1)[:, None])
    few = visible.clone()
    for view in (0, 2, 3, 4):  # one vertex has no contrast, four determine the light
        few[view, visible[view].nonzero()[view:, 0]] = False
    images = scene.views.images.clone().requires_grad_()
    changed = scene.replace(views=scene.views.replace(images=images))
    found = loss(ball, changed, few)
    assert_close(found, alone)
    found.backward()
    assert images.grad.isfinite().all()
    with pytest.raises(pt.InputError, match="no photograph shows more than 4"):
        loss(ball, scene, torch.zeros_like(visible))


@pytest.mark.parametrize("name", ["normals", "vertices", "images", "poses"])
@pytest.mark.parametrize("kind", [pt.losses.PhotometricLoss, pt.losses.ConsistencyLoss])
def test_gradients_of_photometric_losses_agree_with_finite_differences(scene, ball, name, kind):
    loss, generator = kind(), torch.Generator().manual_seed(1)
    noisy = ball.normals_world + 0.2 * torch.randn(
        ball.normals_world.shape, generator=generator, dtype=torch.float64
    )
    ball = ball.replace(normals_world=noisy)
    visible, views = loss.visible(ball, scene), scene.views
    values = {
        "normals": noisy,
        "vertices": ball.vertices_world,
        "images": views.images,
        "poses": torch.zeros(5, 6, dtype=torch.float64),
    }

    def function(value):
        surface, changed = ball, scene
        if name == "normals":
            surface = ball.replace(normals_world=value)
        elif name == "vertices":
            surface = ball.replace(vertices_world=value)
        elif name == "images":
            changed = scene.replace(views=views.replace(images=value))
        else:
            changed = scene.replace(cameras=scene.cameras.retract(value))
        return loss(surface, changed, visible)

    direction = torch.randn(values[name].shape, generator=generator, dtype=torch.float64)
    assert_close(*slope(function, values[name], direction), rtol=2e-3, atol=1e-7)


def test_distances_to_a_true_surface(ball):
    loss = pt.losses.PointToSurfaceLoss(ball.mesh)
    assert loss(ball) < 1e-9
    grown = loss(ball.replace(vertices_world=1.1 * ball.vertices_world))
    assert float(grown) == pytest.approx(0.1, abs=2e-3)
    generator = torch.Generator().manual_seed(0)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=generator).double()).Q
    turned = 1.05 * ball.vertices_world @ turn  # not above edges, where the nearest face changes
    direction = torch.randn(turned.shape, generator=generator).double()
    found = slope(lambda value: loss(ball.replace(vertices_world=value)), turned, direction)
    assert_close(*found, rtol=1e-3, atol=1e-9)
    half = ball.replace(information=(ball.vertices_world[:, 0] > 0).double())
    far = half.vertices_world.clone()
    far[~half.supported] *= 3
    assert loss(half.replace(vertices_world=far)) < 1e-9  # unsupported vertices do not count


def test_normals_in_photographs(scene, ball):
    rotations, maps = scene.cameras.cam_from_world[:, :3, :3], []
    rendered = torch.zeros(5, 120, 160, 3, dtype=torch.float64)
    variance = torch.full((5, 120, 160), torch.inf, dtype=torch.float64)
    for view in range(5):
        hits = cast_view(ball.mesh, scene.cameras, view)
        seen = hits.face >= 0
        corners = ball.normals_world[ball.faces[hits.face[seen]]]
        normal = (hits.barycentric[seen][:, :, None] * corners).sum(dim=1)
        rendered[view][seen] = torch.nn.functional.normalize(normal, dim=1) @ rotations[view].mT
        variance[view][seen] = 0.01
        maps.append(int(seen.sum()))
    assert min(maps) > 1000
    truth = pt.NormalPrior(
        names=scene.views.names,
        sizes_px=scene.cameras.sizes_px,
        undistorted=True,
        normals=rendered,
        variance=variance,
    )
    loss = pt.losses.NormalLoss(truth)
    assert loss(ball, scene) < 1e-4
    angle = math.radians(10)
    turn = torch.eye(3, dtype=torch.float64)
    turn[:2, :2] = torch.tensor(
        [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    )
    visible = pt.losses.well_visible(ball, scene.cameras)
    turned = loss(ball.replace(normals_world=ball.normals_world @ turn.mT), scene, visible)
    assert 0 < turned < 1 - math.cos(angle)
    direction = torch.randn(ball.normals_world.shape, generator=torch.Generator().manual_seed(0))
    found = slope(
        lambda value: loss(ball.replace(normals_world=value), scene, visible),
        ball.normals_world @ turn.mT,
        direction.double(),
    )
    assert_close(*found, rtol=1e-4, atol=1e-9)
    with pytest.raises(pt.InputError, match="needed: camera axes"):
        pt.losses.NormalLoss(truth.replace(frame="world"))
    with pytest.raises(pt.InputError, match="no map has a normal where"):
        loss(ball, scene, torch.zeros_like(visible))


def test_distances_to_silhouettes(scene, ball):
    inside = (scene.views.images.sum(dim=1) > 0).double()
    silhouettes = pt.Silhouettes.everything(scene.views).replace(
        inside=inside, reliable=torch.ones(5, dtype=torch.bool)
    )
    loss = pt.losses.SilhouetteLoss(silhouettes, scene.cameras)
    still = loss(ball, scene.cameras)
    assert still < 1.5
    shift_px = 5.0
    offset = torch.tensor([shift_px * 4.0 / 180.0, 0.0, 0.0], dtype=torch.float64)
    assert loss(moved(ball, offset), scene.cameras) > still + 1.0
    assert loss(ball.replace(vertices_world=1.1 * ball.vertices_world), scene.cameras) > still + 1.5
    grown = 1.04 * ball.vertices_world
    direction = torch.randn(grown.shape, generator=torch.Generator().manual_seed(0)).double()
    found = slope(
        lambda value: loss(ball.replace(vertices_world=value), scene.cameras), grown, direction
    )
    assert_close(*found, rtol=1e-3, atol=1e-9)


def test_cameras_move_by_steps_in_se3(scene):
    cameras = scene.cameras
    still = cameras.retract(torch.zeros(5, 6, dtype=torch.float64))
    assert_close(still.cam_from_world, cameras.cam_from_world)
    delta = torch.zeros(5, 6, dtype=torch.float64)
    delta[:, 5] = 0.3
    motion = cameras.retract(delta).cam_from_world @ torch.linalg.inv(cameras.cam_from_world)
    assert_close(motion[0, 0, 0], torch.tensor(math.cos(0.3)).double())
    assert_close(motion[0, 1, 0], torch.tensor(math.sin(0.3)).double())
    far = cameras.retract(torch.randn(5, 6, generator=torch.Generator().manual_seed(0)).double())
    assert not [*far.faults()]
    for start in (torch.zeros(5, 6).double(), 0.3 * delta):
        assert torch.autograd.gradcheck(
            lambda value: cameras.retract(value).cam_from_world, start.requires_grad_()
        )


def test_visibility_of_another_surface_is_refused(scene, ball):
    visible = pt.losses.PhotometricLoss().visible(ball, scene)
    for loss in (pt.losses.PhotometricLoss(), pt.losses.ConsistencyLoss()):
        with pytest.raises(pt.InputError, match="needed: of the surface's"):
            loss(ball, scene, visible[:, 1:])
