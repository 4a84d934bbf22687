"""Photographs that were cropped beside a model of whole ones, and those that were resized."""

import json
import warnings

import numpy as np
import pytest
import torch
from PIL import Image
from torch.nn.functional import interpolate, pad
from torch.testing import assert_close

from pimper_torch.doors.io.photographs import load_views
from pimper_torch.ground.geometry.lens_models import pinhole_of
from pimper_torch.ground.radiometry import to_bytes
from pimper_torch.method.sfm.colmap import write_binary
from pimper_torch.method.sfm.existing import existing_ways
from pimper_torch.method.sfm.reconstruct import Reconstruct
from pimper_torch.method.sfm.reconstruct_config import ReconstructConfig
from pimper_torch.records import Lens, Views
from pimper_torch.runtime.errors import InputError, PimperWarning
from tests.sfm.ball import (
    FOCAL,
    HEIGHT,
    WIDTH,
    cameras_on_an_arc,
    model_of,
    photographs,
    points_on_the_ball,
)


def existing_model(views, path):
    return existing_ways(views, path).plain[0]


@pytest.fixture(scope="module")
def whole() -> Views:
    return photographs(cameras_on_an_arc())


@pytest.fixture(scope="module")
def unlit() -> Views:
    """Photographs whose light stays, so that features match."""
    return photographs(cameras_on_an_arc(), lit=False)


@pytest.fixture(scope="module")
def sparse(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sparse")
    generator = torch.Generator().manual_seed(11)
    model = model_of(cameras_on_an_arc(), points_on_the_ball(150, generator), generator, 0.2)
    write_binary(model, to_bytes(torch.ones(len(model.points_world), 3)), folder)
    return folder


def cropped(views: Views, left: int, top: int, right: int, bottom: int) -> Views:
    """Cut borders off; negative ones are added, dark as a sensor's margin."""
    images = pad(views.images, (-left, -right, -top, -bottom), value=0.01)
    size = torch.tensor([images.shape[3], images.shape[2]])
    return views.replace(images=images, sizes_px=size.expand(views.num_views, 2).clone())


def center(lens: Lens) -> tuple[float, float]:
    """Return the principal point."""
    return tuple(pinhole_of(lens)[:2, 2].tolist())


def resized(views: Views, width: int, height: int) -> Views:
    images = interpolate(views.images, size=(height, width), mode="bilinear", antialias=True)
    return views.replace(images=images, sizes_px=torch.tensor([[width, height]] * views.num_views))


@pytest.mark.parametrize("size", [(158, 119), (960, 720)])
def test_resized_photographs_are_no_crop(whole, sparse, size):
    plain = existing_model(whole, sparse)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = existing_model(resized(whole, *size), sparse)
    scale = torch.tensor(size).double() / torch.tensor([WIDTH, HEIGHT])
    assert_close(found.observation_pixels, plain.observation_pixels * scale, rtol=0, atol=1e-9)
    principal = torch.tensor(found.lenses[0].params[1:3], dtype=torch.float64)
    assert_close(principal, torch.tensor(size).double() / 2, rtol=0, atol=1e-9)
    assert {lens.camera for lens in found.lenses} == {1}


@pytest.fixture
def transforms(tmp_path):
    """The cameras without points."""
    cameras = cameras_on_an_arc()
    world_from_cam = torch.linalg.inv(cameras.cam_from_world)
    world_from_cam[:, :3, 1:3] *= -1
    whole = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    frames = [
        {"file_path": f"{view}.png", "transform_matrix": pose.tolist()}
        for view, pose in enumerate(world_from_cam)
    ]
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({**whole, "frames": frames}))
    return path


RECONSTRUCT = Reconstruct(ReconstructConfig(threads=1))


@pytest.mark.parametrize(
    "borders",
    [
        (20, 20, 20, 20),  # another shape
        (40, 30, 40, 30),  # the same shape: a resize would explain it
        (-9, -4, -9, -4),  # margins of raw
    ],
)
def test_matches_tell_where_photographs_were_cropped(unlit, sparse, transforms, borders):
    for path in (sparse, transforms):
        with pytest.warns(PimperWarning) as told:
            scene = RECONSTRUCT(cropped(unlit, *borders), path)
        about = [str(one.message) for one in told if "resized" in str(one.message)]
        assert len(about) == 1
        assert "6 of 6 photographs (0.png" in about[0]
        assert "tells that these are no resized ones" in about[0]
        assert ("what their matches show" in about[0]) or path == sparse
        width, height = WIDTH - borders[0] - borders[2], HEIGHT - borders[1] - borders[3]
        for lens in scene.lenses:
            assert (lens.width, lens.height) == (width, height)
            assert lens.params[0] == FOCAL
            principal = (WIDTH / 2 - borders[0], HEIGHT / 2 - borders[1])
            assert center(lens) == pytest.approx(principal, abs=1.0)
        off = (scene.points_world.norm(dim=1) - 1).abs()  # a pixel is 0.005 on the ball
        assert float(off.median()) < 0.002
        assert float(scene.reprojection_errors_px.median()) < 1.0


def test_photographs_under_light_that_moves_and_cropped_are_told_by_their_matches(whole, sparse):
    plain = existing_model(whole, sparse)
    with pytest.warns(PimperWarning, match="no resized ones"):
        scene = RECONSTRUCT(cropped(whole, 40, 30, 40, 30), sparse)
    assert len(scene.points_world) == len(plain.points_world)
    assert center(scene.lenses[0]) == pytest.approx((WIDTH / 2 - 40, HEIGHT / 2 - 30), abs=1.0)


def test_one_cropped_photograph_among_whole_ones_is_another_cameras(whole, sparse):
    one = cropped(whole, 24, 18, 24, 18)
    images, sizes = whole.images.clone(), whole.sizes_px.clone()
    images[2] = 0
    images[2, :, : HEIGHT - 36, : WIDTH - 48], sizes[2] = one.images[2], one.sizes_px[2]
    with pytest.warns(PimperWarning, match=r"1 of 6 photographs \(2\.png\)"):
        scene = RECONSTRUCT(whole.replace(images=images, sizes_px=sizes), sparse)
    assert center(scene.lenses[2]) == pytest.approx((WIDTH / 2 - 24, HEIGHT / 2 - 18), abs=1.0)
    assert center(scene.lenses[1]) == (WIDTH / 2, HEIGHT / 2)


def test_photographs_cropped_in_their_files_and_shrunk_on_reading(whole, sparse, tmp_path):
    cut = cropped(whole, 40, 20, 40, 20)
    for name, image in zip(cut.names, cut.images, strict=True):
        array = to_bytes(image.expand(3, -1, -1)).permute(1, 2, 0).numpy()
        Image.fromarray(np.ascontiguousarray(array)).save(tmp_path / name)
    views = load_views(tmp_path, max_size_px=300)  # of 400
    with pytest.warns(PimperWarning, match="no resized ones"):
        scene = RECONSTRUCT(views, sparse)
    lens = scene.lenses[0]
    assert (lens.width, lens.height) == (300, 240)
    assert lens.params[0] == pytest.approx(0.75 * FOCAL)
    assert center(lens) == pytest.approx((150, 120), abs=1.0)


def test_other_photographs_of_another_shape_are_no_crop(whole, sparse):
    order = [3, 5, 4, 0, 2, 1]
    shuffled = cropped(whole.replace(images=whole.images[order]), 40, 0, 0, 0)
    with pytest.raises(InputError, match=r"6 of 6.*does not tell which crop"):
        RECONSTRUCT(shuffled, sparse)


def test_photographs_of_cameras_without_points_that_were_resized_are_no_crop(unlit, transforms):
    with pytest.warns(PimperWarning) as told:
        scene = RECONSTRUCT(resized(unlit, 341, 256), transforms)
    assert not [one for one in told if "resized" in str(one.message)]
    assert scene.lenses[0].params[2:4] == pytest.approx((170.5, 128))


def test_where_nothing_tells_photographs_are_taken_as_resized(whole, sparse, transforms):
    blank = cropped(whole.replace(images=torch.full_like(whole.images, 0.3)), 40, 30, 40, 30)
    for path in (sparse, transforms):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            scene = RECONSTRUCT(blank, path)
        assert not [one for one in told if "resized" in str(one.message)]
        assert scene.lenses[0].params[0] == pytest.approx(FOCAL * 400 / 480)


def test_photographs_of_another_shape_that_hardly_match_are_refused(whole, transforms):
    blank = cropped(whole.replace(images=torch.full_like(whole.images, 0.3)), 40, 0, 0, 0)
    with pytest.raises(InputError, match=r"6 of 6.*matches.*does not tell which crop.*not cropped"):
        RECONSTRUCT(blank, transforms)
