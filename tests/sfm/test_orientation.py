"""Models of the pixels that files store, beside photographs that EXIF, or somebody, turned."""

import warnings

import pytest
import torch
from torch.testing import assert_close

from pimper_torch.ground.radiometry import to_bytes
from pimper_torch.method.sfm.colmap import write_binary
from pimper_torch.method.sfm.existing import existing_ways
from pimper_torch.method.sfm.lenses import QUARTERS
from pimper_torch.method.sfm.sparse_scene import assemble_scene
from pimper_torch.records import Views
from pimper_torch.runtime.errors import InputError, PimperWarning
from tests.sfm.ball import (
    HEIGHT,
    WIDTH,
    cameras_on_an_arc,
    model_of,
    photographs,
    points_on_the_ball,
)

TOLD = "pictures that stand otherwise"
EXIF = {quarters: tag for tag, quarters in QUARTERS.items()}


def existing_model(views, path):
    return existing_ways(views, path).plain[0]


@pytest.fixture(scope="module")
def stored() -> Views:
    """Photographs as their files store them."""
    return photographs(cameras_on_an_arc())


@pytest.fixture(scope="module")
def sparse(tmp_path_factory):
    """A model of the pixels that files store."""
    return written(tmp_path_factory.mktemp("sparse"))


def written(folder, count=6, points=150):
    generator = torch.Generator().manual_seed(11)
    model = model_of(
        cameras_on_an_arc(count), points_on_the_ball(points, generator), generator, 0.2
    )
    write_binary(model, to_bytes(torch.ones(len(model.points_world), 3)), folder)
    return folder


def turned(views: Views, quarters: list[int]) -> Views:
    """Turn photographs clockwise, as reading them does where EXIF says so."""
    side = max(views.images.shape[-2:])
    images = views.images.new_zeros(*views.images.shape[:2], side, side)
    sizes = views.sizes_px.clone()
    for view, turns in enumerate(quarters):
        width, height = views.sizes_px[view].tolist()
        picture = torch.rot90(views.images[view, :, :height, :width], -turns, dims=(1, 2))
        images[view, :, : picture.shape[1], : picture.shape[2]] = picture
        sizes[view] = torch.tensor([picture.shape[2], picture.shape[1]])
    tags = torch.tensor([EXIF[turns] for turns in quarters])
    return views.replace(images=images, sizes_px=sizes, orientations=tags)


def back(model, quarters):
    """Turn poses back by hand: the picture's right becomes what was its down, and so on."""
    poses = model.cam_from_world.clone()
    for view, turns in enumerate(quarters):
        angle = torch.tensor(-turns * torch.pi / 2, dtype=torch.float64)
        c, s = angle.cos().round(), angle.sin().round()
        poses[view] = (
            torch.block_diag(torch.stack([c, -s, s, c]).reshape(2, 2), torch.eye(2)).to(poses)
            @ poses[view]
        )
    return poses


@pytest.mark.parametrize(
    "quarters",
    [[2] * 6, [1] * 6, [3] * 6, [2, 0, 0, 2, 0, 0], [0, 1, 3, 2, 1, 0]],
)
def test_a_model_of_stored_pixels_gives_the_cameras_of_photographs_that_were_not_turned(
    stored, sparse, quarters
):
    plain = existing_model(stored, sparse)
    views = turned(stored, quarters)
    with pytest.warns(PimperWarning, match=TOLD):
        found = existing_model(views, sparse)
    assert torch.equal(back(found, quarters), plain.cam_from_world)
    assert torch.equal(found.points_world, plain.points_world)
    # Lenses, pixels and poses belong together, and to the pictures.
    scene, plain_scene = assemble_scene(views, found), assemble_scene(stored, plain)
    assert_close(
        scene.reprojection_errors_px, plain_scene.reprojection_errors_px, rtol=0, atol=1e-9
    )
    for view, turns in enumerate(quarters):
        width, height = views.sizes_px[view].tolist()
        picture = torch.rot90(scene.views.images[view, :, :height, :width], turns, dims=(1, 2))
        assert torch.equal(picture, plain_scene.views.images[view])


def test_a_model_of_photographs_as_exif_turns_them_is_taken_as_it_is(stored, sparse):
    plain = existing_model(stored, sparse)
    tags = torch.tensor([3, 1, 3, 3, 3, 3])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = existing_model(stored.replace(orientations=tags), sparse)
    assert torch.equal(found.cam_from_world, plain.cam_from_world)
    assert torch.equal(found.observation_pixels, plain.observation_pixels)


def test_square_photographs_are_turned_as_their_points_tell(stored, tmp_path):
    cut = (WIDTH - HEIGHT) // 2
    generator = torch.Generator().manual_seed(12)
    model = model_of(cameras_on_an_arc(), points_on_the_ball(150, generator), generator, 0.0)
    lens = model.lenses[0].replace(width=HEIGHT, params=(840.0, HEIGHT / 2, HEIGHT / 2, 0.0))
    pixels = model.observation_pixels - model.observation_pixels.new_tensor([cut, 0])
    model = model.replace(lenses=(lens,) * 6, observation_pixels=pixels)
    write_binary(model, to_bytes(torch.ones(len(model.points_world), 3)), tmp_path)
    square = stored.replace(
        images=stored.images[..., cut : cut + HEIGHT].contiguous(),
        sizes_px=torch.tensor([[HEIGHT, HEIGHT]] * 6),
    )
    quarters = [1, 3, 1, 1, 2, 1]
    with pytest.warns(PimperWarning, match=TOLD):
        found = existing_model(turned(square, quarters), tmp_path)
    assert torch.equal(back(found, quarters), existing_model(square, tmp_path).cam_from_world)


def test_photographs_turned_and_made_smaller_have_the_lens_of_that(stored, sparse):
    small = stored.replace(
        images=torch.nn.functional.avg_pool2d(stored.images, 2), sizes_px=stored.sizes_px // 2
    )
    with pytest.warns(PimperWarning, match=TOLD):
        found = existing_model(turned(small, [1] * 6), sparse)
    lens = found.lenses[0]
    assert (lens.width, lens.height) == (HEIGHT // 2, WIDTH // 2)
    assert lens.params == pytest.approx((420.0, HEIGHT / 4, WIDTH / 4, 0.0))
    assert {lens.camera for lens in found.lenses} == {1}


def test_views_of_one_camera_turned_differently_no_longer_share_it(stored, sparse):
    with pytest.warns(PimperWarning, match=TOLD):
        found = existing_model(turned(stored, [2, 0, 0, 2, 0, 0]), sparse)
    cameras = [lens.camera for lens in found.lenses]
    assert cameras[0] == cameras[3] != cameras[1]
    assert len(set(cameras)) == 2


def test_a_mirrored_photograph_beside_a_model_of_stored_pixels_is_refused_by_name(stored, sparse):
    side = max(WIDTH, HEIGHT)
    images = stored.images.new_zeros(6, 1, side, side)
    images[..., :WIDTH, :HEIGHT] = stored.images.mT
    views = stored.replace(
        images=images,
        sizes_px=stored.sizes_px.flip(1),
        orientations=torch.full((6,), 5),
    )
    with pytest.raises(InputError, match=r"0\.png is 360x480.*EXIF does not tell how"):
        existing_model(views, sparse)


def test_without_points_both_ways_are_left_open(stored, tmp_path):
    folder = written(tmp_path, points=0)
    views = turned(stored, [2] * 6)
    upright, as_stored = existing_ways(views, folder).plain
    plain = existing_model(stored, folder)
    assert torch.equal(upright.cam_from_world, plain.cam_from_world)
    assert torch.equal(back(as_stored, [2] * 6), plain.cam_from_world)
    assert len(existing_ways(stored, folder).plain) == 1


def test_of_a_model_of_two_cameras_the_photographs_folder_takes_its_own(stored, tmp_path):
    generator = torch.Generator().manual_seed(13)
    own = model_of(cameras_on_an_arc(), points_on_the_ball(50, generator), generator, 0.2)
    both = own.replace(
        names=tuple(f"{folder}/{name}" for folder in ("cam2", "cam1") for name in own.names),
        lenses=own.lenses * 2,
        cam_from_world=torch.cat([own.cam_from_world.flip(0), own.cam_from_world]),
        observation_point=own.observation_point.repeat(2),
        observation_view=torch.cat([5 - own.observation_view, 6 + own.observation_view]),
        observation_pixels=own.observation_pixels.repeat(2, 1),
    )
    write_binary(both, to_bytes(torch.ones(len(own.points_world), 3)), tmp_path)
    found = existing_model(stored.replace(folder="/data/cam1"), tmp_path)
    assert_close(found.cam_from_world, own.cam_from_world, rtol=0, atol=1e-12)  # by quaternions
    with pytest.raises(InputError, match=r"0\.png may be any of cam2/0\.png, cam1/0\.png"):
        existing_model(stored.replace(folder="/data/photos"), tmp_path)
