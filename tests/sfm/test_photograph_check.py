"""Photographs that do not show what their cameras see are named and left out."""

import pytest
import torch
from scenes import observed
from sparse_models import views_of
from torch.nn.functional import grid_sample, interpolate

import pimper_torch as pt
from pimper_torch.geometry.pinholes import look_at, pinholes
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import project, rays_through
from pimper_torch.records import CameraModel
from pimper_torch.stages.sfm.photograph_check import correlations, of_something_else
from pimper_torch.stages.sfm.sparse_scene import sound

VIEWS, WIDTH, HEIGHT, FOCAL = 9, 160, 120, 170.0


def texture(seed):
    """Return smooth noise over the square of side 4 about the origin."""
    noise = torch.rand(1, 1, 50, 50, generator=torch.Generator().manual_seed(seed))
    return interpolate(noise, (400, 400), mode="bicubic").clamp(0.05, 0.9)


def photograph(cameras, view, picture):
    """Return what a camera sees of the plane z = 0, under a light of its own."""
    rays = rays_through(
        pixel_centers(WIDTH, HEIGHT, like=cameras.intrinsics).reshape(-1, 2),
        cameras.cam_from_world[view],
        cameras.intrinsics[view],
    )
    eye = cameras.centers_world[view]
    places = (eye - eye[2] / rays[:, 2:] * rays)[:, :2]
    values = grid_sample(picture, places[None, None] / 2, align_corners=False)[0, 0, 0]
    light = 0.6 + 0.3 * torch.sin(places[:, view % 2] * (1 + view) / 3)
    return (values * light).reshape(1, HEIGHT, WIDTH).expand(3, -1, -1)


@pytest.fixture(scope="module")
def scene():
    """Return a textured plane along an arc, with points that every view observes."""
    turns = torch.deg2rad(torch.linspace(-25, 25, VIEWS))
    eyes = torch.stack([3 * turns.sin(), torch.full_like(turns, -0.6), 3 * turns.cos()], dim=1)
    poses = look_at(eyes, torch.zeros(3), torch.tensor([0.0, 1, 0]))
    cameras = pinholes(poses, FOCAL, WIDTH, HEIGHT)
    images = torch.stack([photograph(cameras, view, texture(0)) for view in range(VIEWS)])
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(1)) * 1.6 - 0.8
    points[:, 2] = 0
    pixels, _ = project(points, cameras.cam_from_world, cameras.intrinsics)
    seen = ((pixels > 0) & (pixels < torch.tensor([WIDTH, HEIGHT]))).all(dim=-1)
    middle = (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    lens = CameraModel(camera=1, model="PINHOLE", params=middle, width=WIDTH, height=HEIGHT)
    return observed(views_of(images), cameras, points, pixels, seen, lens)


def showing(scene, view, image):
    images = scene.views.images.clone()
    images[view] = image
    return scene.replace(views=scene.views.replace(images=images))


def test_photographs_of_their_cameras_are_accepted(scene):
    """Patches of a plane are the same in all views but for their light and resampling."""
    assert correlations(scene)[:, 0].min() > 0.8
    assert of_something_else(scene) == {}
    assert sound(scene) is scene
    double = scene.replace(
        cameras=scene.cameras.to("cpu", torch.float64), points_world=scene.points_world.double()
    )
    assert torch.allclose(correlations(double).float(), correlations(scene), atol=1e-4)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda scene: scene.views.images[4].flip(1, 2),
        lambda scene: scene.views.images[4].flip(2),
        lambda scene: scene.views.images[4].roll(20, 2),
        lambda scene: photograph(scene.cameras, 4, texture(7)),
    ],
)
@pytest.mark.parametrize("observing", [True, False])
def test_a_photograph_of_something_else_is_named_and_left_out(scene, wrong, observing):
    other = showing(scene, 4, wrong(scene))
    if not observing:  # as if features had been matched
        kept = scene.observation_view != 4
        other = other.replace(
            observation_point=scene.observation_point[kept],
            observation_view=scene.observation_view[kept],
            observation_pixels=scene.observation_pixels[kept],
        )
    with pytest.warns(pt.PimperWarning, match=r"its photograph does not show what its camera sees"):
        left = sound(other)
    assert left.views.names == tuple(x for i, x in enumerate(scene.views.names) if i != 4)


def test_nothing_is_concluded_where_views_hardly_correlate_or_have_no_points(scene):
    noise = torch.rand(scene.views.images.shape, generator=torch.Generator().manual_seed(2))
    assert of_something_else(scene.replace(views=scene.views.replace(images=noise))) == {}
    bare = scene.replace(
        points_world=scene.points_world[:0],
        reprojection_errors_px=scene.reprojection_errors_px[:0],
        observation_point=scene.observation_point[:0],
        observation_view=scene.observation_view[:0],
        observation_pixels=scene.observation_pixels[:0],
    )
    assert correlations(bare).isnan().all()
    assert of_something_else(bare) == {}
