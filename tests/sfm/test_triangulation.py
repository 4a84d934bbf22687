"""Points of known cameras on a known ball."""

import json
import warnings
from dataclasses import replace

import pytest
import torch
from torch.nn.functional import avg_pool2d, grid_sample

from pimper_torch.geometry.lens_models import pinhole_of, pinholes_of, undistort_pixels
from pimper_torch.geometry.local_frame import from_local
from pimper_torch.geometry.pixels import grid_from_pixels, pixel_centers
from pimper_torch.geometry.rigid import invert_rigid
from pimper_torch.io.cameras.existing import existing_model
from pimper_torch.records import CameraModel, Views
from pimper_torch.records.sparse_model import SparseModel, select_views
from pimper_torch.runtime.errors import InputError, PimperWarning, ReconstructionError
from pimper_torch.stages.sfm.colmap import observation_errors
from pimper_torch.stages.sfm.epipolar import inliers
from pimper_torch.stages.sfm.matching import VerifiedPair
from pimper_torch.stages.sfm.reconstruct_config import ReconstructConfig
from pimper_torch.stages.sfm.triangulation import lacks_points, triangulate
from tests.sfm.ball import cameras_on_an_arc, model_of, photographs, points_on_the_ball

SETTINGS = ReconstructConfig(threads=1)


@pytest.fixture(scope="module")
def views() -> Views:
    return photographs(cameras_on_an_arc(), lit=False)


@pytest.fixture
def bare(generator) -> SparseModel:
    """The cameras without points."""
    return model_of(cameras_on_an_arc(), torch.zeros(0, 3).double(), generator, 0.2)


@pytest.fixture
def small(views, bare) -> tuple[Views, SparseModel]:
    """Return four photographs at half size: features take an eighth of the time."""
    images, (f, x, y, k) = avg_pool2d(views.images, 2), bare.lenses[0].params
    lens = CameraModel(
        camera=1, model="SIMPLE_RADIAL", params=(f / 2, x / 2, y / 2, k), width=240, height=180
    )
    half = views.replace(images=images, sizes_px=views.sizes_px // 2)
    return half.take(list(range(4))), select_views(bare.replace(lenses=(lens,) * 6), range(4))


def test_points_are_on_the_surface_and_cameras_are_bitwise_equal(views, bare):
    assert lacks_points(bare)
    with pytest.warns(PimperWarning, match=r"model: hardly any.*points were triangulated.*px"):
        found = triangulate(views, bare, SETTINGS, "The model")
    assert torch.equal(found.cam_from_world, bare.cam_from_world)
    assert found.lenses == bare.lenses
    assert found.names == bare.names
    assert not lacks_points(found)
    off = (found.points_world.norm(dim=1) - 1).abs()  # a pixel is 0.005 on the ball
    assert len(off) > 100
    assert float(off.median()) < 0.001
    assert float(off.quantile(0.95)) < 0.01
    assert float(observation_errors(found).median()) < 0.3
    assert bool((torch.bincount(found.observation_point) >= 2).all())


def test_the_result_is_bitwise_equal_on_any_number_of_threads(small):
    found = []
    for threads in (1, 2):
        settings = ReconstructConfig(threads=threads)
        with pytest.warns(PimperWarning, match="were triangulated"):
            found.append(triangulate(*small, settings, "The model"))
    assert torch.equal(found[0].points_world, found[1].points_world)
    assert torch.equal(found[0].observation_pixels, found[1].observation_pixels)


def bent(views: Views, lens: CameraModel) -> Views:
    """Distort photographs of a pinhole by the camera model."""
    K = pinhole_of(lens)
    pixels = pixel_centers(lens.width, lens.height, like=K)
    seen = undistort_pixels(lens, pixels.reshape(-1, 2)) * K.diagonal()[:2] + K[:2, 2]
    grid = grid_from_pixels(seen.reshape(1, *pixels.shape), lens.width, lens.height)
    grid = grid.to(views.images).expand(views.num_views, -1, -1, -1)
    return views.replace(images=grid_sample(views.images, grid, align_corners=False))


def test_matches_follow_the_camera_model(views, bare):
    lens = bare.lenses[0].replace(params=(*bare.lenses[0].params[:3], 0.3))  # 10 px in the corners
    model = bare.replace(lenses=(lens,) * bare.num_views)
    with pytest.warns(PimperWarning, match="were triangulated"):
        found = triangulate(bent(views, lens), model, SETTINGS, "The model")
    assert found.lenses == model.lenses
    assert float((found.points_world.norm(dim=1) - 1).abs().median()) < 0.001
    assert float(observation_errors(found).median()) < 0.3


def test_georeferenced_cameras_give_the_points_of_local_ones(views, bare):
    offset = torch.tensor([448231.25, 5411923.5, 312.125], dtype=torch.float64)
    far = bare.replace(cam_from_world=from_local(bare.cam_from_world, tuple(offset.tolist())))
    with pytest.warns(PimperWarning, match="were triangulated"):
        found = triangulate(views, far, SETTINGS, "The model")
    assert torch.equal(found.cam_from_world, far.cam_from_world)
    assert len(found.points_world) > 100
    assert float(((found.points_world - offset).norm(dim=1) - 1).abs().median()) < 0.001
    assert float(observation_errors(found).median()) < 0.3


def axes(*signs: int) -> torch.Tensor:
    return torch.diag(torch.tensor([*signs, 1], dtype=torch.float64))


@pytest.mark.parametrize(
    "wrong",
    [
        invert_rigid,
        lambda pose: axes(1, -1, -1) @ pose,
        lambda pose: invert_rigid(pose) @ axes(1, -1, -1),
        lambda pose: pose[[3, 0, 1, 2]],
    ],
)
def test_cameras_that_contradict_the_photographs_are_rejected(small, wrong):
    views, bare = small
    model = bare.replace(cam_from_world=wrong(bare.cam_from_world))
    with pytest.raises(InputError, match=r"The model: these cameras.*at least 50%.*x right"):
        triangulate(views, model, SETTINGS, "The model")


def test_blank_or_tiny_photographs_give_no_points_and_a_warning(views, bare):
    """COLMAP's feature extraction ends the process on images of a few pixels."""
    blank = views.replace(images=torch.full_like(views.images, 0.3))
    tiny = views.replace(images=views.images[..., :6, :8], sizes_px=torch.tensor([[8, 6]] * 6))
    for some in (blank, tiny):
        with pytest.warns(PimperWarning, match="0 could be triangulated from features"):
            assert triangulate(some, bare, SETTINGS, "The model") is bare


def test_existing_points_are_kept_if_no_more_are_found(small, generator):
    few = model_of(cameras_on_an_arc(), points_on_the_ball(5, generator), generator, 0.2)
    views, bare = small
    few = select_views(few, range(4)).replace(lenses=bare.lenses)
    few = few.replace(observation_pixels=few.observation_pixels / 2)
    assert lacks_points(few)
    blank = views.replace(images=torch.full_like(views.images, 0.3))
    with pytest.warns(PimperWarning, match="could be triangulated"):
        assert triangulate(blank, few, SETTINGS, "The model") is few
    with pytest.warns(PimperWarning, match="were triangulated"):
        more = triangulate(views, few, SETTINGS, "The model")
    assert len(more.points_world) > 10 * len(few.points_world)


def test_inliers_are_on_the_epipolar_line_in_front_of_both_cameras(generator):
    model = model_of(cameras_on_an_arc(2), points_on_the_ball(30, generator), generator, 0.0)
    cameras = pinholes_of(model)
    pixels = [model.observation_pixels[model.observation_view == view] for view in (0, 1)]
    pair = VerifiedPair(views=(0, 1), first=pixels[0], second=pixels[1])
    assert bool(inliers(cameras, pair, 1e-6).all())
    lifted = pair.replace(second=pair.second + pair.second.new_tensor([0.0, 5.0]))
    assert not bool(inliers(cameras, lifted, 2.0).any())
    behind = cameras.replace(cam_from_world=axes(-1, -1, -1) @ cameras.cam_from_world)
    assert not bool(inliers(behind, pair, 1e-6).any())
    swapped = pair.replace(views=(1, 0), first=pair.second, second=pair.first)
    assert bool(inliers(cameras, swapped, 1e-6).all())


def test_the_warning_is_emitted_without_track_refinement(small):
    settings = replace(SETTINGS, track_iterations=0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = triangulate(*small, settings, "The model")
    assert [str(one.message).count("points were triangulated") for one in caught] == [1]
    assert torch.equal(found.cam_from_world, small[1].cam_from_world)


def test_a_file_without_cameras_of_the_photographs_is_rejected(views, tmp_path):
    pose = torch.eye(4).tolist()
    frames = [{"file_path": "../../etc/passwd", "transform_matrix": pose}]
    whole = {"w": 80, "h": 60, "fl_x": 90.0, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(whole))
    with pytest.raises((InputError, ReconstructionError), match="has none of the photographs"):
        existing_model(views, tmp_path / "transforms.json")
