import numpy as np
import pytest
import tifffile
import torch
from torch.testing import assert_close

from pimper_torch.io.decode import decode, read_header
from pimper_torch.io.photographs import load_views
from pimper_torch.radiometry import LINEAR, Encoding
from pimper_torch.runtime.errors import InputError, PimperWarning


@pytest.fixture
def both(tmp_path):
    """Write the same TIFF with 8 and 16 bits, and read both."""

    def read(array, **options):
        found = []
        for name, one in (("8", array), ("16", array.astype(np.uint16) * 257)):
            tifffile.imwrite(tmp_path / f"{name}.tif", one, **options)
            found.append(decode(tmp_path / f"{name}.tif"))
        return found

    return read


def planes(array):
    values = torch.from_numpy(array / 255).float()
    return values[None] if values.ndim == 2 else values.movedim(-1, 0)


def with_more(pixels):
    return np.concatenate([pixels, pixels[..., :1]], axis=2)


@pytest.mark.parametrize(
    ("array", "wanted", "options"),
    [
        (lambda rgb: 255 - rgb[..., 0], lambda rgb: rgb[..., 0], {"photometric": "miniswhite"}),
        (lambda rgb: rgb, lambda rgb: rgb, {"photometric": "rgb"}),
        (
            lambda rgb: np.moveaxis(rgb, -1, 0),
            lambda rgb: rgb,
            {"photometric": "rgb", "planarconfig": "separate"},
        ),
        (with_more, lambda rgb: rgb, {"photometric": "rgb", "extrasamples": ["unspecified"]}),
        (with_more, with_more, {"photometric": "rgb", "extrasamples": ["unassalpha"]}),
    ],
)
def test_samples_are_the_same_at_either_depth(both, pixels, array, wanted, options):
    for decoded in both(array(pixels), **options):
        found = decoded.samples
        if decoded.alpha is not None:
            found = torch.cat([found, decoded.alpha[None]])
        assert_close(found, planes(wanted(pixels)), rtol=0, atol=1e-6)


def test_extra_samples_are_ignored_with_a_warning(pixels, tmp_path):
    options = {"photometric": "rgb", "extrasamples": ["unspecified"]}
    for index in range(3):
        tifffile.imwrite(tmp_path / f"{index}.tif", with_more(pixels), **options)
    message = r"3 of 3 .* has extra samples of unknown meaning"
    with pytest.warns(PimperWarning, match=message):
        assert load_views(tmp_path).masks is None


@pytest.mark.parametrize("factor", [np.uint8(1), np.uint16(257)])
def test_thumbnails_in_a_tiff_are_skipped(tmp_path, pixels, factor):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        file.write(pixels * factor, photometric="rgb")
        for step, marked in ((1, 1), (2, 0)):
            file.write(pixels[::step, ::step] * factor, photometric="rgb", subfiletype=marked)
    header = read_header(tmp_path / "a.tif")
    assert ((header.width, header.height), header.cautions) == ((12, 8), ())
    assert_close(decode(tmp_path / "a.tif").samples, planes(pixels), rtol=0, atol=1e-6)


@pytest.mark.parametrize("kinds", [(0, 0), (1, 0), (0, 1, 0)])
def test_several_pages_are_refused_with_how_to_split_them(tmp_path, pixels, kinds):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for kind in kinds:
            file.write(pixels, photometric="rgb", subfiletype=kind)
    with pytest.raises(
        InputError, match=r"a\.tif: has several pages.*`magick in\.tif out_%d\.tif`"
    ):
        read_header(tmp_path / "a.tif")


@pytest.mark.parametrize(
    ("kind", "options", "why"),
    [
        (np.uint8, {"photometric": "separated"}, "is CMYK of 8 bits.*`magick in.tif"),
        (np.uint16, {"photometric": "separated"}, "is CMYK of 16 bits, 4 samples per pixel"),
        (np.uint8, {"photometric": "cielab"}, "is CIELab of 8 bits, 3 samples per pixel"),
        (np.uint16, {"photometric": "cielab"}, "is CIELab of 16 bits, 3 samples per pixel"),
        (np.uint16, {"photometric": "ycbcr"}, "is YCbCr of 16 bits, 3 samples"),
        (np.uint16, {"photometric": "minisblack", "extrasamples": [2, 0]}, "gray of 16 bits, 3 s"),
        (np.uint8, {"photometric": "rgb", "extrasamples": [1]}, "colours multiplied by opac"),
        (np.uint16, {"photometric": "rgb", "extrasamples": [1]}, "colours multiplied by op"),
        (np.uint16, {"photometric": "rgb", "extrasamples": [2, 0]}, "RGB of 16 bits, 5 samples"),
        (np.int8, {"photometric": "rgb"}, "its samples are int8; needed: integers of 8"),
        (np.float32, {"photometric": "rgb"}, "its samples are float32; needed: integers of 8"),
        (np.uint32, {"photometric": "rgb"}, "its samples are uint32; needed: integers of 8"),
        (np.uint16, {"photometric": "cfa"}, "is camera raw with the suffix of TIFF"),
    ],
)
def test_other_samples_are_refused_by_name(tmp_path, pixels, kind, options, why):
    colours = {"separated": 4, "minisblack": 1, "cfa": 1}.get(options["photometric"], 3)
    array = np.concatenate([pixels, pixels], axis=2)[
        ..., : colours + len(options.get("extrasamples", ()))
    ]
    array = array[..., 0] if array.shape[2] == 1 else array
    tifffile.imwrite(tmp_path / "a.tif", array.astype(kind), **options)
    with pytest.raises(InputError, match=rf"a\.tif: .*{why}"):
        decode(tmp_path / "a.tif")


@pytest.mark.parametrize("bits", [10, 14])
def test_sixteen_bit_files_of_fewer_bits_give_a_warning(tmp_path, pixels, write_png16, bits):
    levels = (pixels.astype(np.uint16) * 257) >> (16 - bits)
    for index in range(3):
        write_png16(tmp_path / f"{index}.png", levels)
    message = rf"no value of its 16-bit files is above \d+ of 65535.*{bits} bits.*{2**bits - 1}"
    with pytest.warns(PimperWarning, match=message):
        load_views(tmp_path)
    given = Encoding(response="linear", saturation=float(2**bits - 1))
    found = load_views(tmp_path, encoding=given).images[0]
    assert_close(found.double(), torch.from_numpy(levels / (2**bits - 1)).movedim(-1, 0))
    load_views(tmp_path, encoding=LINEAR)  # full scale is forced


@pytest.mark.parametrize("noise", [0.0, 0.0005])
def test_saturation_is_found_equally_at_either_depth(tmp_path, noise):
    """A sensor that saturates at 0.8 of full scale, with noise as of a subtracted dark frame."""
    generator = np.random.default_rng(6)
    found = []
    light = 1.3 * generator.random((4, 60, 90, 3)) ** 3
    light = light.clip(max=0.8) + noise * generator.standard_normal(light.shape)
    for kind in (np.uint8, np.uint16):
        folder = tmp_path / np.dtype(kind).name
        folder.mkdir()
        full = np.iinfo(kind).max
        for index, one in enumerate(light):
            levels = (full * one).round().clip(0, full).astype(kind)
            tifffile.imwrite(folder / f"{index}.tif", levels, photometric="rgb")
        with pytest.warns(PimperWarning, match="pile up at"):
            found.append(load_views(folder, encoding=Encoding(response="linear")).images)
    assert_close(*found, rtol=0, atol=0.006)  # a level of 255
