import pytest
import torch

from pimper_torch.geometry.projection import project
from pimper_torch.stages.sfm.track_observations import log_pictures, observe_points, tangent_planes
from tests.sfm import ball


@pytest.fixture(scope="module")
def scene():
    generator = torch.Generator().manual_seed(3)
    cameras = ball.cameras_on_an_arc()
    points = ball.points_on_the_wall(150, generator)
    planes = tangent_planes(points, torch.ones(len(points), 6, dtype=torch.bool), cameras)
    pixels, _ = project(points, cameras.cam_from_world, cameras.intrinsics)
    return cameras, planes, pixels


def pictures(views):
    valid = views.inside if views.masks is None else views.masks
    raster = (views.num_views, *views.images.shape[-2:])
    return log_pictures(zip(views.images, valid, strict=True), raster)


def errors(found, pixels):
    return (found.pixels - pixels[found.view, found.point]).norm(dim=1)


@pytest.mark.parametrize("lit", [False, True], ids=["one light", "another light each"])
def test_points_are_observed_in_all_views_to_a_twentieth_of_a_pixel(scene, lit):
    cameras, planes, pixels = scene
    found = observe_points(pictures(ball.photographs(cameras, lit=lit, wall=True)), cameras, planes)
    assert len(found.point) > 0.85 * 6 * 150
    assert errors(found, pixels).median() < (0.05 if lit else 0.02)


def test_chunks_of_points_give_bitwise_equal_results(scene):
    cameras, planes, _ = scene
    shown = pictures(ball.photographs(cameras, wall=True))
    at_once = observe_points(shown, cameras, planes)
    in_parts = observe_points(shown, cameras, planes, at_once=64)
    for name in ("point", "view", "pixels"):
        assert torch.equal(getattr(at_once, name), getattr(in_parts, name))


def test_observations_correct_misprojected_points(scene):
    cameras, planes, _ = scene
    rotated = cameras.cam_from_world.clone()
    rotated[3, 0, 3] += 2 * 4.0 / ball.FOCAL  # two pixels
    wrong = cameras.replace(cam_from_world=rotated)
    shown = pictures(ball.photographs(cameras, lit=False, wall=True))
    found = observe_points(shown, wrong, planes)
    mine = (found.view == 3) & (planes.reference[found.point] != 3)
    # Pixels in the reference follow the wrong camera, so its own points are excluded.
    right, _ = project(planes.points_world, cameras.cam_from_world[3], cameras.intrinsics[3])
    assert mine.sum() > 60
    assert (found.pixels[mine] - right[found.point[mine]]).norm(dim=1).median() < 0.05
    near = observe_points(shown, wrong, planes, max_shift_px=1.0)
    assert not ((near.view == 3) & (planes.reference[near.point] != 3)).any()


def test_occluders_are_not_observed_as_the_point(scene):
    cameras, planes, _ = scene
    views = ball.photographs(cameras, wall=True)
    images = views.images.clone()
    images[2] = 0.2 * torch.rand(1, ball.HEIGHT, ball.WIDTH).double()
    found = observe_points(pictures(views.replace(images=images)), cameras, planes)
    other = planes.reference[found.point] != 2
    assert not (found.view[other] == 2).any()


@pytest.mark.parametrize("how", ["masked", "saturated", "not finite"])
def test_patches_missing_from_a_view_are_not_observed(scene, how):
    cameras, planes, pixels = scene
    views = ball.photographs(cameras, wall=True)
    left = torch.zeros(6, ball.HEIGHT, ball.WIDTH, dtype=torch.bool)
    left[1, :, : ball.WIDTH // 2] = True
    if how == "masked":
        views = views.replace(masks=~left)
    else:
        value = 1.0 if how == "saturated" else torch.nan
        views = views.replace(images=torch.where(left[:, None], value, views.images))
    found = observe_points(pictures(views), cameras, planes)
    here = found.view == 1
    assert here.any()
    assert (found.pixels[here, 0] > ball.WIDTH / 2 - 8).all()
    assert errors(found, pixels)[here].median() < 0.05


def test_untextured_and_striped_patches_are_not_observed(scene):
    cameras, planes, _ = scene
    views = ball.photographs(cameras, wall=True)
    plain = torch.full_like(views.images, 0.3)
    assert len(observe_points(pictures(views.replace(images=plain)), cameras, planes).point) == 0
    stripes = torch.sin(torch.arange(ball.WIDTH) / 2.5).double().expand(ball.HEIGHT, -1)
    noise = torch.rand(plain.shape, generator=torch.Generator().manual_seed(1)).double()
    images = plain + 0.2 * stripes + 0.02 * noise
    found = observe_points(pictures(views.replace(images=images)), cameras, planes)
    assert len(found.point) < 0.05 * 6 * 150


def test_observations_are_sorted_and_include_the_reference(scene):
    cameras, planes, pixels = scene
    found = observe_points(pictures(ball.photographs(cameras, wall=True)), cameras, planes)
    key = found.point * 6 + found.view
    assert (key.diff() > 0).all()
    own = found.view == planes.reference[found.point]
    assert set(found.point[own].tolist()) == set(found.point.tolist())
    torch.testing.assert_close(
        found.pixels[own], pixels[found.view[own], found.point[own]], rtol=0, atol=1e-9
    )


def test_log_images_are_offset_by_a_fiftieth_of_the_median_gray():
    wide = torch.full((3, 8, 12), 0.5, dtype=torch.float64)
    wide[0] = 0.2
    wide[:, 0, 0] = torch.tensor([0.1, 1.0, 0.1])  # saturated in one channel
    wide[1, 0, 1] = torch.nan
    wide[:, 0, 2] = 0  # black
    small = torch.full((3, 4, 6), 0.4)
    valid = torch.ones(8, 12, dtype=torch.bool)
    valid[7, 11] = False
    found = log_pictures([(wide, valid), (small, valid[:4, :6])], (2, 8, 12))

    usable = torch.zeros(2, 8, 12, dtype=torch.bool)
    usable[0] = valid
    usable[0, 0, :2] = False
    usable[1, :4, :6] = True
    assert torch.equal(found.unusable == 0, usable)
    gray = torch.zeros(2, 8, 12)
    gray[0], gray[1] = 0.4, 0.4
    gray[0, 0, 2] = 0
    expected = (gray + 0.02 * 0.4).log()
    torch.testing.assert_close(found.log[usable], expected[usable])
