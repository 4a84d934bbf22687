import pytest
import torch
from torch.testing import assert_close

from pimper_torch.geometry.lens_models import distort
from pimper_torch.geometry.local_frame import NO_OFFSET, from_local
from pimper_torch.geometry.rigid import transform
from pimper_torch.io.cameras.model_files import read_model
from pimper_torch.stages.sfm.colmap import reprojection_errors
from pimper_torch.stages.sfm.reconstruct import Reconstruct
from pimper_torch.stages.sfm.sparse_scene import assemble_scene, point_colors, write_model
from pimper_torch.stages.silhouettes.cues import cues_of
from pimper_torch.stages.silhouettes.silhouette_config import SilhouetteConfig


def test_writing_a_model_and_reading_it_gives_the_same_scene(scene, views, tmp_path):
    write_model(scene, tmp_path / "new" / "sparse", point_colors(scene))
    again = Reconstruct()(views, tmp_path / "new" / "sparse")
    assert again.lenses == scene.lenses
    assert again.views.names == scene.views.names
    assert again.unregistered == ()
    # Rotations pass through unit quaternions.
    assert_close(again.cameras.cam_from_world, scene.cameras.cam_from_world, rtol=0, atol=1e-12)
    assert_close(again.cameras.intrinsics, scene.cameras.intrinsics)
    assert torch.equal(again.points_world, scene.points_world)
    assert torch.equal(again.observation_point, scene.observation_point)
    assert torch.equal(again.observation_view, scene.observation_view)
    assert torch.equal(again.observation_pixels, scene.observation_pixels)
    assert_close(again.reprojection_errors_px, scene.reprojection_errors_px)
    assert_close(again.views.images, scene.views.images)


def test_reprojection_errors_are_mean_distances_and_infinite_behind_a_camera(model):
    # The fixture's noise is 0.3 px per coordinate: its mean length is 0.3 * sqrt(pi / 2).
    errors = reprojection_errors(model)
    assert 0.30 < errors.mean() < 0.45
    first = (model.observation_point == 0).nonzero()[:, 0]
    pixels = model.observation_pixels.clone()
    for row in first:  # exact except for 5 px in one view
        view = int(model.observation_view[row])
        point = transform(model.cam_from_world[view], model.points_world[:1])
        pixels[row] = distort(model.lenses[view], point)[0]
    pixels[first[0]] += pixels.new_tensor([3.0, 4.0])
    changed = reprojection_errors(model.replace(observation_pixels=pixels))
    assert_close(float(changed[0]), 5 / len(first))
    assert torch.equal(changed[1:], errors[1:])
    points = model.points_world.clone()
    points[0, 2] = -100
    errors = reprojection_errors(model.replace(points_world=points))
    assert errors[0].isinf()
    assert errors[1:].isfinite().all()


def test_points_have_the_color_of_their_views(scene):
    red = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    images = red[:, None, None].expand(5, 3, 60, 80)
    colored = scene.replace(views=scene.views.replace(images=images))
    assert (point_colors(colored) == torch.tensor([255, 0, 0])).all()


def test_maps_to_a_static_background_are_those_of_the_model(scene, views, model):
    maps = torch.eye(3, dtype=torch.float64).repeat(5, 1, 1)
    maps[4] = torch.nan
    assert len(scene.background_from_view) == 0
    found = assemble_scene(views, model.replace(background_from_view=maps)).background_from_view
    assert_close(found, maps, equal_nan=True)


UTM = (448231.25, 5411923.5, 312.125)
FAR = [UTM, (-3e7, 0.0, 2.0)]


def moved(model, offset):
    return model.replace(
        cam_from_world=from_local(model.cam_from_world, offset),
        points_world=model.points_world + model.points_world.new_tensor(offset),
    )


@pytest.mark.parametrize("offset", FAR)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_model_far_from_the_origin_gives_the_same_scene(views, model, offset, dtype):
    views = views.to(dtype)
    plain, far = assemble_scene(views, model), assemble_scene(views, moved(model, offset))
    assert plain.offset_world == NO_OFFSET
    shift = torch.tensor(offset, dtype=torch.float64) - torch.tensor(far.offset_world).double()
    assert float(shift.abs().max()) < 1.5
    assert_close(far.points_world, (plain.points_world + shift).to(dtype), rtol=0, atol=1e-6)
    centers = plain.cameras.centers_world + shift
    assert_close(far.cameras.centers_world, centers.to(dtype), rtol=0, atol=4e-6)
    assert_close(
        far.reprojection_errors_px, plain.reprojection_errors_px, rtol=0, atol=1e-4
    )  # 3e7 in double precision, 20 px per unit
    assert torch.equal(far.views.images, plain.views.images)


@pytest.mark.parametrize("offset", FAR)
def test_a_scene_far_from_the_origin_is_written_in_the_model_frame(views, model, offset, tmp_path):
    far = moved(model, offset)
    scene = assemble_scene(views.to(torch.float32), far)
    write_model(scene, tmp_path, point_colors(scene))
    read = read_model(tmp_path)
    # The scene is in single precision, its model in the user's frame is not.
    assert_close(read.points_world, far.points_world, rtol=0, atol=1e-6)
    centers = [
        -(one.cam_from_world[:, :3, :3].mT @ one.cam_from_world[:, :3, 3:])[..., 0]
        for one in (read, far)
    ]
    assert_close(*centers, rtol=0, atol=4e-6)
    assert float(reprojection_errors(read).median()) < 1.2 * float(
        reprojection_errors(far).median()
    )


def test_a_region_is_a_box_in_the_frame_of_the_model(views, model):
    region = (-0.5, -0.4, -0.3, 0.5, 0.6, 0.7)
    corners = torch.tensor(region, dtype=torch.float64).reshape(2, 3)
    settings = SilhouetteConfig(
        region=tuple((corners + torch.tensor(UTM, dtype=torch.float64)).flatten().tolist())
    )
    scene = assemble_scene(views, moved(model, UTM))
    box = cues_of(scene, settings).box_world
    local = (
        corners + torch.tensor(UTM, dtype=torch.float64) - corners.new_tensor(scene.offset_world)
    )
    assert_close(box.double(), local, rtol=0, atol=1e-6)
