import warnings

import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from pimper_torch.io.decode import decode, read_header, rotated
from pimper_torch.io.photograph_files import list_images
from pimper_torch.io.photographs import load_views
from pimper_torch.radiometry import Linear
from pimper_torch.runtime.errors import InputError, PimperWarning
from tests.io.dng import XYZ_TO_CAMERA, write_dng

SRGB_TO_XYZ = torch.tensor(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ],
    dtype=torch.float64,
)
NEUTRAL = torch.tensor([0.5, 1.0, 0.7], dtype=torch.float64)
BLACK, WHITE = 256, 4000
X_TRANS = np.array(
    [
        [1, 1, 0, 1, 1, 2],
        [1, 1, 2, 1, 1, 0],
        [2, 0, 1, 0, 2, 1],
        [1, 1, 2, 1, 1, 0],
        [1, 1, 0, 1, 1, 2],
        [0, 2, 1, 2, 0, 1],
    ]
)


@pytest.fixture(autouse=True)
def needs_rawpy():
    pytest.importorskip("rawpy")


@pytest.fixture
def colours():
    """Linearly varying radiance in sRGB primaries, for which interpolation is exact."""
    v, u = torch.meshgrid(torch.arange(40.0), torch.arange(60.0), indexing="ij")
    planes = torch.stack([0.10 + u / 300, 0.15 + v / 250, 0.12 + (u + v) / 500]).double()
    return planes


def sensor_of(colours):
    """Return samples of a camera with this matrix: saturation 1, red and blue below green."""
    matrix = torch.tensor(XYZ_TO_CAMERA, dtype=torch.float64) @ SRGB_TO_XYZ
    matrix = matrix / matrix.sum(dim=1, keepdim=True)
    return torch.einsum("ij,jhw->ihw", NEUTRAL[:, None] * matrix, colours)


def mosaic_of(sensor):
    """Select one colour per pixel, as a sensor does."""
    planes = sensor.clone()
    out = planes[1].clone()
    out[::2, ::2], out[1::2, 1::2] = planes[0, ::2, ::2], planes[2, 1::2, 1::2]
    return (BLACK + (WHITE - BLACK) * out).round().clamp(0, WHITE).numpy().astype(np.uint16)


@pytest.fixture
def folder(tmp_path, colours):
    for index in range(3):
        write_dng(tmp_path / f"{index}.dng", mosaic_of(sensor_of(colours)), equivalent=50)
    return tmp_path


def test_raw_is_linear_radiance_in_the_primaries_of_srgb(folder, colours):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = load_views(folder).images[0].double()
    inner = (slice(None), slice(3, -3), slice(3, -3))
    scale = (colours / found)[inner].median()
    assert_close(scale * found[inner], colours[inner], rtol=0, atol=0.002)  # 3,744 levels
    colour = read_header(folder / "0.dng").colour
    assert (colour.response, colour.source) == (Linear(), "camera raw")


def test_samples_are_scaled_from_black_to_saturation(folder, colours):
    decoded = decode(folder / "0.dng")
    assert (decoded.full, decoded.lossy) == (65535, False)
    assert read_header(folder / "0.dng").full_scale_given
    inner = (slice(None), slice(3, -3), slice(3, -3))
    wanted = sensor_of(colours)[inner].float()
    assert_close(decoded.samples[inner], wanted, rtol=0, atol=5e-4)  # a level of 3,744


def test_a_level_of_saturation_below_full_scale_is_counted_from_black(folder, monkeypatch, colours):
    monkeypatch.setattr("pimper_torch.io.raw._white", lambda _: 3000)
    inner = (slice(None), slice(3, -3), slice(3, -3))
    found = decode(folder / "0.dng").samples
    wanted = sensor_of(colours).float() * (WHITE - BLACK) / (3000 - BLACK)
    assert_close(found[inner], wanted[inner], rtol=0, atol=5e-4)


def test_dark_raw_keeps_its_depth_and_scales_with_exposure(tmp_path, colours):
    for index, exposure in enumerate((1.0, 0.25, 0.25)):
        write_dng(tmp_path / f"{index}.dng", mosaic_of(exposure * sensor_of(colours)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        images = load_views(tmp_path).images.double()
    inner = (slice(None), slice(3, -3), slice(3, -3))
    # No automatic brightening: a quarter of the light is a quarter of the radiance.
    assert_close(images[1][inner], images[0][inner] / 4, rtol=0, atol=5e-4)


def test_pixels_interpolated_from_a_saturated_sample_are_saturated(tmp_path, colours):
    sensor = sensor_of(colours)
    sensor[:, 10:14, 20:24] = 5.0
    sensor[:, 30, 40] = 5.0  # a single red sample
    for index in range(3):
        write_dng(tmp_path / f"{index}.dng", mosaic_of(sensor))
    images = load_views(tmp_path).images
    wanted = torch.zeros(40, 60, dtype=torch.bool)
    wanted[9:15, 19:25] = True
    wanted[29:32, 39:42] = True
    assert torch.equal((images[0] == 1).all(dim=0), wanted)
    assert float(images[0][:, ~wanted].max()) < 0.9


def test_other_sensors_and_full_colour_raw_are_read(tmp_path, colours):
    sensor = sensor_of(colours)
    sensor[:, 10:13, 20:23] = 5.0
    whole = (BLACK + (WHITE - BLACK) * sensor).round().clamp(0, WHITE).movedim(0, -1)
    write_dng(tmp_path / "all.dng", whole.numpy().astype(np.uint16))
    index = torch.from_numpy(np.tile(X_TRANS, (7, 10))[:40, :60])
    one = whole.gather(2, index[..., None])[..., 0].numpy().astype(np.uint16)
    write_dng(tmp_path / "x.dng", one, pattern=X_TRANS)
    for name, reach in (("all", 0), ("x", 3)):
        samples = decode(tmp_path / f"{name}.dng").samples
        wanted = torch.zeros(40, 60, dtype=torch.bool)
        wanted[10 - reach : 13 + reach, 20 - reach : 23 + reach] = True
        full = (samples == 1).all(dim=0)
        assert torch.equal(full, wanted)
        away = (slice(None), slice(20, -8), slice(8, -8))
        ratio = samples[away] / sensor[away].float()
        assert float((ratio / ratio.median() - 1).abs().max()) < 0.03


@pytest.mark.parametrize(("orientation", "size"), [(3, (60, 40)), (6, (40, 60))])
def test_raw_is_rotated_by_its_exif_orientation(tmp_path, colours, orientation, size):
    mosaic = mosaic_of(sensor_of(colours))
    write_dng(tmp_path / "a.dng", mosaic)
    write_dng(tmp_path / "b.dng", mosaic, orientation=orientation, equivalent=50)
    header = read_header(tmp_path / "b.dng")
    assert (header.orientation, (header.width, header.height)) == (orientation, size)
    upright = decode(tmp_path / "a.dng").samples.movedim(0, -1).numpy()
    wanted = torch.from_numpy(rotated(upright, orientation)).movedim(-1, 0)
    assert torch.equal(decode(tmp_path / "b.dng").samples, wanted)
    diagonal = np.hypot(60, 40) / np.hypot(36, 24)
    assert header.focal_px == pytest.approx(50 * diagonal)
    assert np.isnan(read_header(tmp_path / "a.dng").focal_px)


def test_raw_takes_precedence_over_the_jpeg_of_the_same_photograph(folder, pixels):
    raw = load_views(folder)
    for name in ("0.jpg", "1.JPG", "2.jpeg"):
        Image.fromarray(pixels).save(folder / name)
    message = r"0\.jpg, 1\.JPG, 2\.jpeg were not read, as camera raw with the same names was\."
    with pytest.warns(PimperWarning, match=message) as warned:
        beside = load_views(folder)
    assert len(warned) == 1
    assert beside.names == ("0.dng", "1.dng", "2.dng")
    assert torch.equal(beside.images, raw.images)


def test_a_developed_file_takes_precedence_over_its_raw(folder, pixels):
    Image.fromarray(pixels).save(folder / "1.tif")
    assert [path.name for path in list_images(folder)] == ["0.dng", "1.tif", "2.dng"]
    Image.fromarray(pixels).save(folder / "1.jpg")
    with pytest.raises(InputError, match="differ only in their suffix"):
        list_images(folder)


def test_raw_is_cropped_like_the_cameras_image(tmp_path, colours):
    mosaic = mosaic_of(sensor_of(colours))
    write_dng(tmp_path / "whole.dng", mosaic, orientation=6)
    # The light-sensitive area of 60 x 40 excludes 2 rows and 4 columns, and the image more.
    margins = {"active": (2, 4, 38, 58), "crop": (4, 2, 48, 30)}
    write_dng(tmp_path / "crop.dng", mosaic, orientation=6, **margins)
    header = read_header(tmp_path / "crop.dng")
    assert (header.width, header.height) == (30, 48)
    whole, crop = (decode(tmp_path / f"{name}.dng").samples for name in ("whole", "crop"))
    rows, columns = slice(8, 56), slice(40 - 34, 40 - 4)  # the bottom is rotated to the left
    assert torch.equal(crop, whole[:, rows, columns])
