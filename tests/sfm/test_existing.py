"""Given cameras of photographs that were resized, turned by EXIF, or cropped."""

import warnings

import pytest
import torch
from torch.testing import assert_close

from pimper_torch.geometry.lens_models import distort
from pimper_torch.geometry.quarter_turns import QUARTERS
from pimper_torch.io.cameras.existing import existing_model
from pimper_torch.radiometry import to_bytes
from pimper_torch.records import CameraModel, Views
from pimper_torch.records.sparse_model import SparseModel
from pimper_torch.records.stored import load_record, save_record
from pimper_torch.runtime.errors import InputError, PimperWarning
from pimper_torch.stages.sfm.colmap import reconstruction_of, write_binary
from pimper_torch.stages.sfm.sparse_scene import assemble_scene
from tests.sfm import ball
from tests.sfm.ball import HEIGHT, WIDTH

EXIF = {quarters: tag for tag, quarters in QUARTERS.items()}


@pytest.fixture(scope="module")
def stored() -> Views:
    """Return photographs as stored in files."""
    return ball.photographs(ball.cameras_on_an_arc())


def ball_model(points=150):
    generator = torch.Generator().manual_seed(11)
    points = ball.points_on_the_ball(points, generator)
    return ball.model_of(ball.cameras_on_an_arc(), points, generator, 0.2)


def written(model, folder):
    write_binary(model, to_bytes(torch.ones(len(model.points_world), 3)), folder)
    return folder


@pytest.fixture(scope="module")
def sparse(tmp_path_factory):
    """A model of the stored pixels."""
    return written(ball_model(), tmp_path_factory.mktemp("sparse"))


def turned(views: Views, quarters: list[int]) -> Views:
    """Turn photographs clockwise, as they are read under EXIF orientation."""
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
    """Turn poses back explicitly: image right becomes the former image down."""
    poses = model.cam_from_world.clone()
    for view, turns in enumerate(quarters):
        angle = torch.tensor(-turns * torch.pi / 2, dtype=torch.float64)
        c, s = angle.cos().round(), angle.sin().round()
        turn = torch.block_diag(torch.stack([c, -s, s, c]).reshape(2, 2), torch.eye(2))
        poses[view] = turn.to(poses) @ poses[view]
    return poses


# A quarter turn, evident from the shape, decides for half turns of the same set.
@pytest.mark.parametrize("quarters", [[1] * 6, [3] * 6, [0, 1, 3, 2, 1, 0]])
def test_a_model_of_stored_pixels_gives_the_cameras_of_turned_ones(stored, sparse, quarters):
    plain = existing_model(stored, sparse)
    views = turned(stored, quarters)
    with pytest.warns(PimperWarning, match="before EXIF turns them"):
        found = existing_model(views, sparse)
    assert torch.equal(back(found, quarters), plain.cam_from_world)
    assert torch.equal(found.points_world, plain.points_world)
    cameras = {(turns, lens.camera) for turns, lens in zip(quarters, found.lenses, strict=True)}
    assert len(cameras) == len(set(quarters))  # one camera for each turn
    # Camera models, pixels and poses are consistent with each other and the images.
    scene, plain_scene = assemble_scene(views, found), assemble_scene(stored, plain)
    assert_close(
        scene.reprojection_errors_px, plain_scene.reprojection_errors_px, rtol=0, atol=1e-9
    )
    for view, turns in enumerate(quarters):
        width, height = views.sizes_px[view].tolist()
        picture = torch.rot90(scene.views.images[view, :, :height, :width], turns, dims=(1, 2))
        assert torch.equal(picture, plain_scene.views.images[view])


def test_turned_and_reduced_photographs_have_transformed_camera_models(stored, sparse):
    images = torch.nn.functional.avg_pool2d(stored.images, 2)
    small = stored.replace(images=images, sizes_px=stored.sizes_px // 2)
    with pytest.warns(PimperWarning, match="before EXIF turns them"):
        found = existing_model(turned(small, [1] * 6), sparse)
    lens = found.lenses[0]
    assert (lens.width, lens.height) == (HEIGHT // 2, WIDTH // 2)
    assert lens.params == pytest.approx((420.0, HEIGHT / 4, WIDTH / 4, 0.0))
    assert {lens.camera for lens in found.lenses} == {1}


@pytest.mark.parametrize("text", [False, True])
def test_all_parameters_of_a_lens_are_written_read_and_kept(stored, tmp_path, text):
    numbers = (0.1, -0.2, 1e-3, -2e-3, 0.3, 0.04, -0.05, 0.06)  # k1, k2, p1, p2, k3 to k6
    lens = CameraModel(
        camera=1,
        model="FULL_OPENCV",
        params=(800.0, 810.0, WIDTH / 2 + 1, HEIGHT / 2 - 2, *numbers),
        width=WIDTH,
        height=HEIGHT,
    )
    model = ball_model().replace(lenses=(lens,) * 6)
    path = written(model, tmp_path)
    if text:
        colours = to_bytes(torch.ones(len(model.points_world), 3))
        reconstruction_of(model, colours).write_text(str(path))
        for binary in path.glob("*.bin"):
            binary.unlink()
    assert existing_model(stored, path).lenses == model.lenses
    save_record(model, tmp_path / "model.safetensors")
    assert load_record(SparseModel, tmp_path / "model.safetensors").lenses == model.lenses
    x, y = 0.2, -0.1
    k1, k2, p1, p2, k3, k4, k5, k6 = numbers
    r2 = x * x + y * y
    ratio = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    u = x * ratio + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * ratio + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    # Clockwise, right becomes down, and down becomes left.
    with pytest.warns(PimperWarning, match="before EXIF turns them"):
        found = existing_model(turned(stored, [1] * 6), path).lenses[0]
    expected = [HEIGHT - (810 * v + HEIGHT / 2 - 2), 800 * u + WIDTH / 2 + 1]
    ray = torch.tensor([[-y, x, 1.0]], dtype=torch.float64)
    assert distort(found, ray)[0].tolist() == pytest.approx(expected)


def test_a_model_of_exif_turned_photographs_is_unchanged(stored, sparse):
    plain = existing_model(stored, sparse)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = existing_model(stored.replace(orientations=torch.tensor([3, 6] * 3)), sparse)
    assert torch.equal(found.cam_from_world, plain.cam_from_world)
    # Half turns alone are treated as already applied, and the user is asked.
    with pytest.warns(PimperWarning, match=r"The COLMAP model in .*shapes do not show .*exiftool"):
        found = existing_model(turned(stored, [0, 2] * 3), sparse)
    assert torch.equal(found.cam_from_world, plain.cam_from_world)


def without_columns(views, count=80):
    """Crop photographs on the left."""
    sizes = views.sizes_px - torch.tensor([count, 0])
    return views.replace(images=views.images[..., count:].contiguous(), sizes_px=sizes)


def on_its_side(views, tag=None):
    tags = None if tag is None else torch.full((6,), tag)
    return turned(views, [1] * 6).replace(orientations=tags)


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (without_columns, r"6 of 6 photographs: 0\.png is 400x360, its camera's image 480x360"),
        (on_its_side, r"0\.png is 360x480, its camera's image 480x360"),
        (lambda views: on_its_side(views, tag=5), "0.png is 360x480"),  # which too mirrors
    ],
    ids=["cropped", "turned", "mirrored"],
)
def test_photographs_of_another_shape_are_refused(stored, sparse, change, found):
    needed = r"Needed: the photographs that it was made of.*neither cropped nor turned.*omit the"
    with pytest.raises(InputError, match=f"The COLMAP model in .*{found}.*{needed}"):
        existing_model(change(stored), sparse)


def test_a_folder_of_photographs_uses_its_camera_of_a_model_with_two(stored, tmp_path):
    own = ball_model(50)
    both = own.replace(
        names=tuple(f"{folder}/{name}" for folder in ("cam2", "cam1") for name in own.names),
        lenses=own.lenses * 2,
        cam_from_world=torch.cat([own.cam_from_world.flip(0), own.cam_from_world]),
        observation_point=own.observation_point.repeat(2),
        observation_view=torch.cat([5 - own.observation_view, 6 + own.observation_view]),
        observation_pixels=own.observation_pixels.repeat(2, 1),
    )
    written(both, tmp_path)
    found = existing_model(stored.replace(folder="/data/cam1"), tmp_path)
    assert_close(found.cam_from_world, own.cam_from_world, rtol=0, atol=1e-12)  # via quaternions
    with pytest.raises(InputError, match=r"0\.png may be any of cam2/0\.png, cam1/0\.png"):
        existing_model(stored.replace(folder="/data/photos"), tmp_path)
