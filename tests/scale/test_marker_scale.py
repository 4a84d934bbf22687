"""Printed markers in photographs: a sheet rendered by homographies with antialiasing."""

import io

import matplotlib
import numpy as np
import pytest
import torch
from PIL import Image

import pimper_torch as pt
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.cli.options import bundled_photographs
from pimper_torch.geometry.opencv import area_resized, warped
from pimper_torch.geometry.pixels import scale_intrinsics
from pimper_torch.scale import marker_scale
from pimper_torch.scale.aruco import find_squares
from pimper_torch.scale.find_scale import find_scale
from pimper_torch.scale.given import CameraDistance
from pimper_torch.scale.marker_scale import Marker, find_markers, scale_of_markers
from pimper_torch.scale.sheet import MAX_SIDE_MM, MIN_SIDE_MM, PAPERS_MM, layout, side_of
from pimper_torch.viz.marker_sheet import draw_sheet

WIDTH, HEIGHT, FOCAL = 640, 480, 700.0
FINE = 4  # oversampling
DPI = 25.4 * 6
MM = 0.01  # in scene units, arbitrary


def picture_of(side_mm, paper="a4"):
    """Rasterize a sheet with six pixels per millimetre."""
    file = io.BytesIO()
    with matplotlib.rc_context({"path.snap": False}):  # keep edges between pixels
        draw_sheet(side_mm, paper).savefig(file, format="png", dpi=DPI)
    drawn = np.asarray(Image.open(file).convert("L"), dtype=np.float32) / 255
    return torch.from_numpy(drawn.copy())


@pytest.fixture(scope="module")
def sheet():
    return picture_of(30)


def world_from_picture(paper="a4"):
    """Map pixels of a sheet to the plane z = 0, its centre at the origin and y up."""
    width, height = PAPERS_MM[paper]
    step = MM / 6
    return torch.tensor(
        [[step, 0, -MM * width / 2], [0, -step, MM * height / 2], [0, 0, 1]], dtype=torch.float64
    )


def photographed(picture, cameras, paper="a4"):
    """Render a sheet on a grey table: pixels are means of linear radiance."""
    images = []
    for K, pose in zip(cameras.intrinsics, cameras.cam_from_world, strict=True):
        pinhole = scale_intrinsics(K, FINE, FINE) @ pose[:3]
        pixels_from_picture = pinhole[:, [0, 1, 3]] @ world_from_picture(paper)
        large = (FINE * WIDTH, FINE * HEIGHT)
        seen = warped(picture, torch.linalg.inv(pixels_from_picture), large)
        linear = (0.01 + 0.6 * seen).nan_to_num(nan=0.1)
        images.append(area_resized(linear[None], WIDTH, HEIGHT).expand(3, -1, -1))
    return torch.stack(images)


def cameras_of(num_views=6, span_deg=70.0):
    return arc_cameras(
        num_views,
        width=WIDTH,
        height=HEIGHT,
        focal_px=FOCAL,
        distance=5.0,
        span_deg=span_deg,
        elevation_deg=20.0,
    )


def scene_of(images, cameras):
    return pt.scene_of(images, cameras.intrinsics, cameras.cam_from_world)


@pytest.fixture(scope="module")
def images(sheet):
    return photographed(sheet, cameras_of())


@pytest.fixture(scope="module")
def scene(images):
    return scene_of(images, cameras_of())


def test_a_photographed_sheet_gives_the_scale(scene):
    scale = scale_of_markers(scene)
    assert scale.factor * MM == pytest.approx(1, rel=1e-3)
    assert scale.residual < 1e-3
    assert scale.count == 16
    assert (scale.unit, scale.source) == ("mm", "markers")


def test_markers_are_triangulated_at_their_printed_positions(scene):
    printed = layout(30)
    width, height = PAPERS_MM["a4"]
    for marker in find_markers(scene):
        left_mm, top_mm = printed[marker.code]
        left, top = left_mm - width / 2, height / 2 - top_mm
        corners = [(left, top), (left + 30, top), (left + 30, top - 30), (left, top - 30)]
        wanted = MM * torch.tensor([[*corner, 0.0] for corner in corners], dtype=torch.float64)
        off = (marker.corners_world - wanted).norm(dim=1) / MM
        assert float(off.max()) < 0.1  # a seventh of a pixel


def test_measured_marker_sides_and_units_can_be_given(scene):
    plain = scale_of_markers(scene)
    assert scale_of_markers(scene, side_mm=27.0).factor == pytest.approx(0.9 * plain.factor)
    assert scale_of_markers(scene, unit="in").factor == pytest.approx(plain.factor / 25.4)


def test_marker_ids_give_the_sides_of_a_sheet():
    assert side_of(min(layout(20))) == 20
    cameras = cameras_of(3, 40.0)
    scene = scene_of(photographed(picture_of(36, "letter"), cameras, "letter"), cameras)
    assert scale_of_markers(scene).factor * MM == pytest.approx(1, rel=2e-3)


@pytest.mark.parametrize("paper", PAPERS_MM)
def test_markers_of_a_sheet_are_separate_and_have_unique_ids(paper):
    codes = []
    for side in range(MIN_SIDE_MM, MAX_SIDE_MM + 1):
        markers = layout(side, paper)
        assert 10 <= len(markers) <= 16
        assert all(side_of(code) == side for code in markers)
        codes += markers
        corners = torch.tensor(list(markers.values()))
        assert bool((corners >= 10).all())
        assert bool((corners + side + 10 <= torch.tensor(PAPERS_MM[paper])).all())
        apart = (corners[:, None] - corners).abs().amax(dim=-1).fill_diagonal_(torch.inf)
        assert float(apart.min()) >= side + side / 8  # a white cell
    assert len(set(codes)) == len(codes)
    with pytest.raises(pt.ConfigError, match="side_mm is 37; needed: 10 to 36 whole millimetres"):
        layout(37, paper)


def test_a_single_photograph_gives_no_scale(images):
    one = torch.stack([images[0], torch.full_like(images[0], 0.2)])
    assert scale_of_markers(scene_of(one, cameras_of().take([0, 1]))) is None


def test_static_markers_are_excluded_for_a_turning_object(images):
    still = images[:1].expand(6, -1, -1, -1)
    assert scale_of_markers(scene_of(still, cameras_of())) is None


def test_a_photograph_with_a_moved_marker_is_an_outlier(images):
    shifted = images.clone()
    shifted[2] = images[2].roll(25, dims=2)
    scale = scale_of_markers(scene_of(shifted, cameras_of()))
    assert scale.factor * MM == pytest.approx(1, rel=2e-3)


def test_overexposed_paper_does_not_shrink_markers(images):
    """Blurred edges of saturated paper move into the black, by 2 % of these markers."""
    cameras = cameras_of()
    soft = torch.nn.functional.avg_pool2d(images, 3, stride=1, padding=1)
    soft[[0, 2, 4, 5]] = (2.5 * soft[[0, 2, 4, 5]]).clamp(max=1)
    scale = scale_of_markers(scene_of(soft, cameras))
    assert scale.factor * MM == pytest.approx(1, rel=2e-3)
    everywhere = scene_of((2.5 * soft).clamp(max=1), cameras)
    assert scale_of_markers(everywhere) is None


def square(code, side):
    corners = torch.tensor([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=torch.float64)
    return Marker(code=code, corners_world=side * corners, num_views=3)


@pytest.mark.parametrize(("wrong", "known"), [(1, True), (2, False)])
def test_the_scale_is_that_of_the_majority_of_markers_or_none(scene, monkeypatch, wrong, known):
    found = [square(320 + number, 2.0 if number < wrong else 3.0) for number in range(4)]
    monkeypatch.setattr(marker_scale, "find_markers", lambda _: found)
    scale = scale_of_markers(scene)
    assert (scale is not None) == known
    assert scale is None or scale.factor == pytest.approx(10)


def test_an_unknown_marker_needs_a_given_side(scene, monkeypatch):
    monkeypatch.setattr(marker_scale, "find_markers", lambda _: [square(586, 2.0)])
    assert scale_of_markers(scene) is None
    assert scale_of_markers(scene, side_mm=50.0).factor == pytest.approx(25)


def test_a_duplicate_marker_id_in_a_photograph_is_ignored(sheet):
    picture = (255 * sheet[:1000, :600]).to(torch.uint8)
    once = find_squares(picture)
    twice = find_squares(torch.cat([picture, picture], dim=1))
    assert len(once) > 2
    assert not twice


def test_the_bundled_photographs_show_no_marker():
    paths = sorted(bundled_photographs().glob("*.jpg"))[::4]
    assert len(paths) > 4
    for path in paths:
        grey = torch.from_numpy(np.asarray(Image.open(path).convert("L")).copy())
        assert not find_squares(grey)


def test_given_cameras_are_not_scaled_by_markers_alone(scene, reconstruction):
    result = reconstruction.replace(scene=scene)
    assert find_scale(result, own_frame=True) is None
    assert find_scale(result, own_frame=True, markers=30.0).factor * MM == pytest.approx(1, 2e-3)
    assert find_scale(result, markers="off") is None


def test_requested_markers_that_are_missing_give_a_warning(reconstruction):
    with pytest.warns(pt.PimperWarning, match="No marker was found at the same position in"):
        assert find_scale(reconstruction, markers=25.0) is None
    assert find_scale(reconstruction) is None


def test_disagreeing_sources_give_a_warning_and_the_most_accurate_is_used(scene, reconstruction):
    centers = scene.cameras.centers_world
    true = float((centers[0] - centers[5]).norm()) / MM
    result = reconstruction.replace(scene=scene)
    near = [CameraDistance(first="000", second="005", length=1.01 * true)]
    assert find_scale(result, camera_distances=near).source == "markers"
    far = [CameraDistance(first="000", second="005", length=1.1 * true)]
    with pytest.warns(pt.PimperWarning, match=r"markers and the camera distances .*by \+10"):
        scale = find_scale(result, camera_distances=far)
    assert scale.source == "markers"
