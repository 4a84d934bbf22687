import pytest
import torch
from sparse_models import views_of
from torch.testing import assert_close

from pimper_torch.geometry.lens_models import distort, is_pinhole, undistort_pixels
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.undistortion import photograph_pixels, pinhole_for, undistort
from pimper_torch.io.cameras.model_files import camera_models
from pimper_torch.radiometry import SATURATED
from pimper_torch.records import CameraModel, Views


def bent(width: int, height: int, strength: float) -> CameraModel:
    params = (60.0, width / 2 + 1.5, height / 2 - 2.0, strength)
    return CameraModel(camera=1, model="SIMPLE_RADIAL", params=params, width=width, height=height)


def ramp_views(sizes: list[tuple[int, int]]) -> Views:
    # Radiance is the scaled pixel coordinate of the photograph: a ramp before undistortion.
    width, height = (max(side) for side in zip(*sizes, strict=True))
    images = torch.zeros(len(sizes), 2, height, width, dtype=torch.float64)
    for index, (w, h) in enumerate(sizes):
        images[index, :, :h, :w] = pixel_centers(w, h, like=images).permute(2, 0, 1) / 100
    return views_of(images, sizes)


@pytest.mark.parametrize("strength", [3.0, 0.3, -0.2])
def test_a_ramp_of_the_photograph_shows_where_each_pinhole_pixel_came_from(strength):
    sizes = [(50, 40), (36, 44)]
    views = ramp_views(sizes)
    lenses = tuple(bent(w, h, strength) for w, h in sizes)
    undistorted, intrinsics = undistort(views, lenses)
    for index, (w, h) in enumerate(sizes):
        f, cx, cy, k = lenses[index].params
        center = torch.tensor([cx, cy], dtype=torch.float64)
        zoom = intrinsics[index, 0, 0] / f
        assert_close(intrinsics[index, 1, 1] / f, zoom)
        assert_close(intrinsics[index, :2, 2], center)
        x = (pixel_centers(w, h, like=views.images) - center) / (zoom * f)
        source = f * (1 + k * x.square().sum(-1, keepdim=True)) * x + center
        # The ramp ends half a pixel from the border; interpolation is exact inside.
        size = torch.tensor([w, h])
        exact = ((source >= 0.5) & (source <= size - 0.5)).all(-1)
        outside = ((source < 0) | (source > size)).any(-1)
        assert exact.sum() > 0.6 * w * h
        found = 100 * undistorted.images[index, :, :h, :w].permute(1, 2, 0)
        assert_close(found[exact], source[exact])
        assert (found[outside] == 0).all()
        if strength == 3.0:
            assert outside.any()
            assert zoom == 1.25
            assert (undistorted.masks[index, :h, :w] == ~outside).all()
            assert not undistorted.masks[index, h:].any()
            assert not undistorted.masks[index, :, w:].any()
    if strength != 3.0:
        assert undistorted.masks is None


def test_a_pinhole_zooms_in_just_enough_to_exclude_edges():
    lens = bent(50, 40, 0.3)
    f, cx, cy, k = lens.params
    K = pinhole_for(lens)
    assert 1 < K[0, 0] / f < 1.25
    pixels = pixel_centers(200, 160, like=K) / 4 - torch.tensor([cx, cy])

    def overhang(focal: torch.Tensor) -> torch.Tensor:
        x = pixels / focal
        source = f * (1 + k * x.square().sum(-1, keepdim=True)) * x + torch.tensor([cx, cy])
        return torch.maximum(-source, source - torch.tensor([50, 40])).max()

    assert overhang(K[0, 0]) <= 1e-6  # COLMAP's inverse is iterative
    assert overhang(0.97 * K[0, 0]) > 0
    assert pinhole_for(bent(50, 40, -0.2))[0, 0] == f


def test_the_padding_of_a_smaller_photograph_never_leaks_in():
    views = ramp_views([(50, 40), (36, 44)])
    ones = views.replace(images=views.inside[:, None].double())
    lenses = (bent(50, 40, -0.2), bent(36, 44, -0.2))
    undistorted, _ = undistort(ones, lenses)
    assert_close(undistorted.images, ones.images)


def test_masks_are_undistorted_like_the_photograph():
    views = ramp_views([(50, 40)])
    drawn = views.images[:, 0] * 100 < 11.0  # left of a straight line in the photograph
    undistorted, _ = undistort(views.replace(masks=drawn), (bent(50, 40, -0.2),))
    source = photograph_pixels(bent(50, 40, -0.2))
    clear = (source[..., 0] - 11.0).abs() > 0.5
    assert (undistorted.masks[0] == (source[..., 0] < 11.0))[clear].all()


def test_large_photographs_are_undistorted_in_chunks():
    lens = bent(500, 400, 0.02)  # more pixels than are processed per chunk
    K = pinhole_for(lens)
    pixels = pixel_centers(500, 400, like=K).reshape(-1, 2)
    homogeneous = torch.cat([pixels, torch.ones_like(pixels[:, :1])], dim=1)
    expected = distort(lens, torch.linalg.solve(K, homogeneous.mT).mT)
    torch.testing.assert_close(photograph_pixels(lens).reshape(-1, 2), expected, equal_nan=True)


def test_undistortion_is_differentiable():
    views = ramp_views([(6, 5)])
    lens = bent(6, 5, 0.3)

    def undistorted(images: torch.Tensor) -> torch.Tensor:
        return undistort(views.replace(images=images), (lens,))[0].images

    assert torch.autograd.gradcheck(undistorted, views.images.clone().requires_grad_())


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE"])
def test_distortion_and_its_inverse_cancel(model):
    params = {
        "SIMPLE_RADIAL": (60.0, 25.0, 20.0, 0.1),
        "OPENCV": (60.0, 62.0, 25.0, 20.0, 0.05, -0.01, 1e-3, 2e-3),
        "OPENCV_FISHEYE": (60.0, 62.0, 25.0, 20.0, 0.05, -0.01, 1e-3, 2e-3),
    }[model]
    lens = CameraModel(camera=1, model=model, params=params, width=50, height=40)
    pixels = pixel_centers(50, 40, like=torch.zeros(1, dtype=torch.float64)).reshape(-1, 2)
    plane = undistort_pixels(lens, pixels)
    rays = torch.cat([plane, torch.ones_like(plane[:, :1])], dim=1)
    # COLMAP inverts by Newton's method to about 1e-10 of the image plane.
    assert_close(distort(lens, 3 * rays), pixels, rtol=0, atol=1e-6)


def test_pixels_that_touch_a_saturated_one_are_saturated():
    views = ramp_views([(50, 40)])
    images = views.images.clone()
    images[0, 0, 17, 23] = 1.0
    plain, _ = undistort(views, (bent(50, 40, 0.3),))
    lit, _ = undistort(views.replace(images=images), (bent(50, 40, 0.3),))
    lifted = images.clone()
    lifted[0, 0, 17, 23] = 0.9
    weighed, _ = undistort(views.replace(images=lifted), (bent(50, 40, 0.3),))
    touched = weighed.images - plain.images > 1e-2 * (0.9 - views.images[0, 0, 17, 23])
    assert 1 <= int(touched.sum()) <= 9
    assert ((lit.images >= SATURATED) >= touched).all()
    assert torch.equal(lit.images[:, 1], plain.images[:, 1])
    near = (lit.images != plain.images).sum()
    assert near <= touched.sum() + 5


COUNTS = dict(camera_models().values())
FISHEYES = ["FISHEYE", *(name for name in COUNTS if name.endswith("_FISHEYE"))]
STRAIGHT = sorted({*COUNTS} - {*FISHEYES, "EUCM", "EQUIRECTANGULAR"})


def without_coefficients(model: str, focal_px: float) -> CameraModel:
    """Return a camera model with zero coefficients."""
    focal = (focal_px,) * (1 if model.startswith(("SIMPLE_", "RADIAL")) else 2)
    zeros = (0.0,) * (COUNTS[model] - len(focal) - 2)
    return CameraModel(
        camera=1, model=model, params=(*focal, 25.0, 20.0, *zeros), width=50, height=40
    )


@pytest.mark.parametrize("model", FISHEYES)
def test_a_fisheye_without_coefficients_is_equidistant_and_undistorted(model):
    lens = without_coefficients(model, 36.0)  # 40 degrees to the edge
    assert not is_pinhole(lens)
    views = ramp_views([(50, 40)])
    undistorted, intrinsics = undistort(views, (lens,))
    K = intrinsics[0]
    rays = (pixel_centers(50, 40, like=K) - K[:2, 2]) / K[0, 0]
    tangent = rays.norm(dim=-1, keepdim=True)
    source = torch.tensor([25.0, 20.0]) + 36.0 * tangent.atan() * rays / tangent  # r = f theta
    assert_close(photograph_pixels(lens), source)
    assert_close(undistorted.images[0].permute(1, 2, 0) * 100, source)
    assert float((source - pixel_centers(50, 40, like=K)).abs().max()) > 3


@pytest.mark.parametrize("model", STRAIGHT)
def test_a_perspective_lens_without_coefficients_is_bitwise_unchanged(model):
    lens = without_coefficients(model, 36.0)
    views = ramp_views([(50, 40)])
    undistorted, intrinsics = undistort(views, (lens,))
    assert is_pinhole(lens)
    assert torch.equal(undistorted.images, views.images)
    assert undistorted.masks is None
    assert_close(intrinsics[0], torch.tensor([[36.0, 0, 25], [0, 36, 20], [0, 0, 1]]).double())


def test_the_last_coefficient_alone_distorts():
    for model in (*FISHEYES, *STRAIGHT):
        plain = without_coefficients(model, 36.0)
        bends = plain.params[-1] == 0
        assert not bends or not is_pinhole(plain.replace(params=(*plain.params[:-1], 0.05))), model
