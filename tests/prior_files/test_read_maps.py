import math
import struct
import zlib

import numpy as np
import pytest
import torch
from PIL import Image, PngImagePlugin
from sparse_models import views_of
from torch.testing import assert_close

from pimper_torch.io.decode import write_deep_png
from pimper_torch.io.openexr import read_exr, write_exr
from pimper_torch.priors.map_config import NORMALS_ERROR_DEG
from pimper_torch.priors.prior_files.read_maps import read_depth, read_normals
from pimper_torch.runtime.errors import ConfigError, InputError, PimperWarning


@pytest.fixture
def views():
    names = ("a b.jpg", "cup_1.png")
    return views_of(torch.zeros(2, 3, 24, 32), [(32, 24), (24, 24)], names=names)


@pytest.fixture
def normals():
    """Normals of a photograph of 32 x 24 without its last row."""
    drawn = np.random.default_rng(4).normal(size=(24, 32, 3)).astype(np.float32)
    drawn /= np.linalg.norm(drawn, axis=-1, keepdims=True)
    drawn[-1] = 0
    return drawn


def save(path, values):
    if path.suffix == ".exr":
        write_exr(values, path)
    elif path.suffix == ".npz":
        np.savez(path, normals=values, albedo=np.ones((2, 2)), allow_pickle=False)
    elif path.suffix == ".npy":
        np.save(path, values, allow_pickle=False)
    elif "8" in path.name:
        Image.fromarray(np.rint(255 * (values + 1) / 2).astype(np.uint8)).save(path)
    else:
        write_deep_png(np.rint(65535 * (values + 1) / 2).astype(np.uint16), path)


@pytest.mark.parametrize(
    ("file", "tolerance"),
    [
        ("a_b.npy", 1e-6),
        ("a b.npz", 1e-6),
        ("A B.exr", 1e-6),
        ("a b.png", 3e-5),
        ("a b.jpg.npy", 1e-6),
    ],
)
def test_normals_of_every_format_are_read(file, tolerance, views, normals, tmp_path):
    save(tmp_path / file, normals)
    found = read_normals(tmp_path, views, "opencv")
    assert found.names == ("a b.jpg",)
    assert (found.axes, found.frame, found.undistorted) == ("opencv", "camera", False)
    assert_close(found.normals[0], torch.from_numpy(normals), rtol=0, atol=tolerance)
    assert found.variance[0, -1].isinf().all()
    expected = torch.full((23, 32), math.radians(NORMALS_ERROR_DEG) ** 2)
    assert_close(found.variance[0, :-1], expected)
    found.check("test")


def test_world_normals_without_a_negative_component_are_not_decoded(views, tmp_path):
    """A box seen from one corner; its coded map looks the same to a test of signs."""
    sides = np.eye(3, dtype=np.float32)[np.random.default_rng(4).integers(3, size=(24, 32))]
    sides[0] = 0  # unknown
    for values in (sides, (sides + 1) / 2, 127.5 * (sides + 1)):
        np.save(tmp_path / "a b.npy", values, allow_pickle=False)
        found = read_normals(tmp_path, views, "world")
        assert_close(found.normals[0], torch.from_numpy(sides))
        assert found.variance[0, 0].isinf().all()
        assert found.variance[0, 1:].isfinite().all()


def test_eight_bits_and_arrays_in_unit_range_are_decoded(views, normals, tmp_path):
    normals = normals[:, :24]
    Image.fromarray(np.rint(255 * (normals + 1) / 2).astype(np.uint8)).save(tmp_path / "cup_1.png")
    save(tmp_path / "a b.npy", ((normals + 1) / 2).transpose(2, 0, 1)[None, :, :18])
    found = read_normals(tmp_path, views, "dsine", error_deg=10)
    assert found.sizes_px.tolist() == [[24, 18], [24, 24]]
    assert found.axes == "lub"
    assert_close(found.normals[1], torch.from_numpy(normals), rtol=0, atol=0.01)
    assert_close(found.normals[0, :17], torch.from_numpy(normals[:17]), rtol=0, atol=1e-6)
    assert found.variance[0, 18:].isinf().all()  # the padding
    assert_close(found.variance[1, 0, 0], torch.tensor(math.radians(10.0) ** 2))


@pytest.mark.parametrize(
    ("axes", "stored"),
    [
        ("auto", (None, "camera")),
        ("opengl", ("opengl", "camera")),
        ("lub", ("lub", "camera")),
        ("world", ("opencv", "world")),
    ],
)
def test_stated_axes_are_kept(axes, stored, views, normals, tmp_path):
    save(tmp_path / "a b.npy", normals)
    found = read_normals(tmp_path, views, axes)
    assert (found.axes, found.frame) == stored


def test_a_variance_file_or_layer_is_read(views, normals, tmp_path):
    variance = np.full((24, 32), 0.5, np.float32)
    variance[0, 0], variance[1, 0], variance[2, 0] = 0, np.inf, np.nan
    np.savez(tmp_path / "a b.npz", normals=normals, variance=variance, allow_pickle=False)
    save(tmp_path / "cup_1_normal.npy", normals[:, :24])
    np.save(tmp_path / "cup_1_variance.npy", variance[:, :24], allow_pickle=False)
    found = read_normals(tmp_path, views)
    for index, width in ((0, 32), (1, 24)):
        got = found.variance[index, :, :width]
        assert got[0, 0] == torch.inf  # a standard error of 0 is invalid
        assert got[1, 0] == math.radians(NORMALS_ERROR_DEG) ** 2 or got[1, 0].isinf()
        assert (got[3:23] == 0.5).all()
        assert got[23].isinf().all()
    np.save(tmp_path / "cup_1_variance.npy", variance[:, :8], allow_pickle=False)
    with pytest.raises(InputError, match="its variance is 8 x 24; needed: 24 x 24"):
        read_normals(tmp_path, views)


def test_depth_of_every_format_is_read(views, tmp_path):
    drawn = np.random.default_rng(4).uniform(2, 5, size=(24, 32)).astype(np.float32)
    drawn[0, :3] = 0, np.nan, np.inf
    write_exr(drawn[..., None], tmp_path / "a b_depth.exr")
    np.savez(tmp_path / "cup_1.npz", depth=drawn[:, :24], normals=drawn, allow_pickle=False)
    with pytest.warns(PimperWarning, match="2 pixels contain inf, .* missing depth"):
        found = read_depth(tmp_path, views, False, gauge="scale", error=0.1)
    for index, width in ((0, 32), (1, 24)):
        expected = torch.from_numpy(drawn[:, :width])
        assert found.variance[index, 0, :3].isinf().all()
        assert_close(found.depth[index, 1:, :width], expected[1:])
        assert_close(found.variance[index, 1:, :width], (0.1 * expected[1:]) ** 2)
    assert (found.inverse, found.along, found.gauge) == (False, "axis", "scale")
    found.check("test")
    with pytest.warns(PimperWarning, match="contain inf"):
        left_open = read_depth(tmp_path, views, error=0.1)
    assert left_open.inverse is None
    # For maps with an offset, relative to their range without its ends: 0.96 x 3.
    span = math.sqrt(float(left_open.variance[0, 5, 5])) / 0.1
    assert span == pytest.approx(0.96 * 3, rel=0.05)


def depth_with(none, *, dtype=np.float32, near=1000, far=9000):
    """Depth of 24 x 32 whose first row is ``none``."""
    drawn = np.random.default_rng(4).uniform(near, far, size=(24, 32))
    drawn[0] = none
    return drawn.astype(dtype)


@pytest.mark.parametrize(
    ("none", "dtype", "message"),
    [
        (65504, np.float32, "65504"),
        (65504, np.float16, "65504"),
        (65535, np.float32, "65535"),
        (65535, np.uint16, "65535"),
        (65535, np.int32, "65535"),
        (1e10, np.float32, r"1e\+10"),
        (20_000, np.float32, "20000"),
        (17_001, np.uint16, "17001"),
        (-9999, np.float32, "-9999"),
        (np.inf, np.float32, "inf"),
        (np.array([65504, np.inf] * 16), np.float32, "65504, inf"),
    ],
)
def test_values_for_missing_depth_are_ignored_and_counted(none, dtype, message, views, tmp_path):
    np.save(tmp_path / "a b.npy", depth_with(none, dtype=dtype), allow_pickle=False)
    with pytest.warns(PimperWarning, match=f": 32 pixels contain {message}, which is treated"):
        found = read_depth(tmp_path, views)
    assert found.variance[0, 0].isinf().all()
    assert found.variance[0, 1:].isfinite().all()
    np.save(tmp_path / "a b.npy", depth_with(np.nan).astype(np.float32), allow_pickle=False)
    plain = read_depth(tmp_path, views)
    span = found.variance[0, 5, 5] / plain.variance[0, 5, 5]
    scale = float(found.depth[0, 5, 5] / plain.depth[0, 5, 5])
    assert float(span) == pytest.approx(scale**2, rel=2e-3)  # only of the other values


def test_full_scale_values_of_a_gradual_map_are_depth(views, tmp_path):
    levels = depth_with(65535, dtype=np.uint16, near=20_000, far=65_535)
    Image.fromarray(levels).save(tmp_path / "a b.png")
    found = read_depth(tmp_path, views)
    assert found.variance.isfinite()[0].all()
    assert_close(found.depth[0] * 65535, torch.from_numpy(levels.astype(np.float32)))


@pytest.mark.parametrize(
    ("far", "near", "dtype"),
    [
        (16_900, 9000, np.float32),  # a wall, as far behind the rest as this extends
        (9000, 9000, np.float32),  # the same, touching it
        (255, 180, np.uint8),
        ([20_000] + [9000] * 31, 9000, np.float32),  # one pixel
    ],
)
def test_a_largest_depth_near_others_or_of_one_pixel_is_depth(far, near, dtype, views, tmp_path):
    levels = depth_with(far, dtype=dtype, near=min(1000, near / 2), far=near)
    np.save(tmp_path / "a b.npy", levels, allow_pickle=False)
    found = read_depth(tmp_path, views)
    assert found.variance.isfinite()[0].all()


def test_a_far_plane_of_inverse_depth_is_missing(views, tmp_path):
    inverse = 1 / depth_with(1e6, near=2, far=3)
    np.save(tmp_path / "a b.npy", inverse, allow_pickle=False)
    with pytest.warns(PimperWarning, match=": 32 pixels contain 1e-06, which is treated"):
        found = read_depth(tmp_path, views, inverse=True)
    assert found.variance[0, 0].isinf().all()
    assert found.variance[0, 1:].isfinite().all()


def test_depth_in_levels_of_sixteen_bits_is_up_to_its_scale(views, tmp_path):
    levels = np.random.default_rng(4).integers(0, 65536, size=(24, 32)).astype(np.uint16)
    levels[0, 0] = 0
    Image.fromarray(levels).save(tmp_path / "a b.png")
    found = read_depth(tmp_path, views)
    assert_close(found.depth[0] * 65535, torch.from_numpy(levels.astype(np.float32)))
    assert found.variance[0, 0, 0].isinf()


def test_logarithmic_depth_of_moge_is_metres(views, tmp_path):
    """Its format: 1 to 65534 are logarithms from near to far, 0 is missing."""
    near, far = 0.7, 12.5
    depth = np.random.default_rng(4).uniform(near, far, size=(24, 32))
    levels = (1 + np.round(np.log(depth / near) / np.log(far / near) * 65533)).astype(np.uint16)
    levels[0, 0], levels[0, 1] = 0, 65535
    text = PngImagePlugin.PngInfo()
    text.add_text("near", str(near))
    text.add_text("far", str(far))
    Image.fromarray(levels).save(tmp_path / "a b.png", pnginfo=text)
    found = read_depth(tmp_path, views)
    assert found.variance[0, 0, :2].isinf().all()
    expected = torch.from_numpy(depth.astype(np.float32))
    assert_close(found.depth[0, 1:], expected[1:], rtol=1e-4, atol=0)


@pytest.mark.parametrize("packing", [0, 2, 3])
def test_openexr_files_of_other_programs_are_read(packing, tmp_path):
    """Half floats, a window that does not start at 0, and channels sorted by name."""
    values = np.random.default_rng(4).normal(size=(19, 13, 2))
    half, whole = values[..., 0].astype("<f2"), values[..., 1].astype("<u4")
    listed = b"".join(
        name + b"\0" + struct.pack("<IIII", kind, 0, 1, 1)
        for name, kind in ((b"Depth.V", 1), (b"id", 0))
    )
    window = struct.pack("<4i", -4, 7, 8, 25)
    header = b"\x76\x2f\x31\x01" + struct.pack("<I", 2)
    for name, data in (
        (b"channels", listed + b"\0"),
        (b"compression", bytes([packing])),
        (b"dataWindow", window),
    ):
        header += name + b"\0kind\0" + struct.pack("<I", len(data)) + data
    header += b"\0"
    step = {0: 1, 2: 1, 3: 16}[packing]
    blocks = []
    for first in range(0, 19, step):
        rows = range(first, min(first + step, 19))
        raw = b"".join(half[row].tobytes() + whole[row].tobytes() for row in rows)
        plain = np.frombuffer(raw, np.uint8).astype(np.int64)
        order = np.concatenate([plain[::2], plain[1::2]])
        coded = np.concatenate([order[:1], np.diff(order) + 128]) % 256
        packed = zlib.compress(coded.astype(np.uint8).tobytes()) if packing else raw
        packed = raw if len(packed) >= len(raw) else packed
        blocks.append(struct.pack("<iI", 7 + first, len(packed)) + packed)
    at = len(header) + 8 * len(blocks)
    table = np.cumsum([at, *map(len, blocks[:-1])]).astype("<u8").tobytes()
    path = tmp_path / "x.exr"
    path.write_bytes(header + table + b"".join(blocks))
    found = read_exr(path, 1000)
    assert np.array_equal(found["Depth.V"], half.astype(np.float32))
    assert np.array_equal(found["id"], whole.astype(np.float32))
    with pytest.raises(ValueError, match="its header states 13 x 19 pixels of 2 channels"):
        read_exr(path, 400)
    data = path.read_bytes()
    for cut in (*range(0, len(header), 7), len(header) + 9, len(data) - 20):
        path.write_bytes(data[:cut])
        with pytest.raises(ValueError, match=r"cut short or damaged|not an OpenEXR"):
            read_exr(path, 1000)


def test_unsupported_openexr_is_refused_with_its_kind(tmp_path):
    path = tmp_path / "x.exr"
    write_exr(np.ones((4, 4, 1), np.float32), path)
    data = bytearray(path.read_bytes())
    data[5] = 2
    path.write_bytes(data)
    with pytest.raises(ValueError, match="has tiles or several parts"):
        read_exr(path, 1000)
    data[5] = 0
    at = data.index(b"compression\0compression\0") + 28
    data[at] = 4
    path.write_bytes(data)
    with pytest.raises(ValueError, match="its compression is not ZIP"):
        read_exr(path, 1000)


def test_unmatched_names_are_refused_with_a_suggestion(views, normals, tmp_path):
    save(tmp_path / "a b.npy", normals)
    save(tmp_path / "cupp_1.npy", normals)
    with pytest.raises(InputError, match=r"no map for cup_1.png, .* closest .* is cupp_1.npy"):
        read_normals(tmp_path, views)
    (tmp_path / "cupp_1.npy").unlink()
    assert read_normals(tmp_path, views).names == ("a b.jpg",)
    # Maps of removed photographs are not an error.
    alone = views.take([1])
    save(tmp_path / "cup_1.npy", normals[:, :24])
    assert read_normals(tmp_path, alone).names == ("cup_1.png",)


def test_integers_and_named_layers_are_read(views, normals, tmp_path):
    coded = np.rint(65535 * (normals + 1) / 2).astype(np.uint16)
    np.savez(tmp_path / "a b.npz", **{"View.Normals": coded, "x": coded}, allow_pickle=False)
    found = read_normals(tmp_path, views, "opencv")
    assert_close(found.normals[0, :23], torch.from_numpy(normals[:23]), rtol=0, atol=3e-5)


ONES = np.ones((24, 32, 3), np.float32)
LABELS = np.arange(24 * 32, dtype=np.uint8).reshape(24, 32) % 5
COLOURED = np.where(LABELS[..., None] > 2, [1.0, -1, -1], [-1, 1, 1])


@pytest.mark.parametrize(
    ("read", "name", "values", "message"),
    [
        (read_normals, "a b.npy", ONES[..., 0], "has one value per pixel; .* Is it depth"),
        (read_normals, "a b.npy", ONES.swapaxes(0, 1), "is 24 x 32, .* pixels as stored; apply"),
        (read_normals, "a b.npy", ONES[:, :24], "is 24 x 24, .* aspect ratio, at any size"),
        (read_normals, "a b.npy", np.ones((2, 24, 32, 5)), "has shape .*; needed: height width"),
        (read_normals, "a b.npy", np.full((24, 32, 3), "x"), "contains <U1; needed: real numbers"),
        (read_normals, "a b.npy", np.full((24, 32, 3), None), "not a NumPy array .*Python objects"),
        (read_normals, "a b.npy", 200 * ONES / 3**0.5, "lengths are 200 to 200; needed: unit"),
        (read_normals, "a b.txt", ONES, r"contains no maps; needed: files ending in .npz"),
        (read_depth, "a b.npy", 0 * ONES[..., 0], "a b.jpg contain no usable values"),
        (read_depth, "a b.png", ONES * [1, 0, -1], "has colours; needed: one value per pixel"),
        (read_normals, "a b.npy", LABELS, "one value per pixel; .* Are they labels"),
        (read_depth, "a b.npy", LABELS, "has integers below 32, which are labels; needed: depth"),
        (read_depth, "a b.npy", LABELS.astype(np.int64), "integers below 32, which are labels"),
        (read_depth, "a b.png", COLOURED, "has labels in 2 colours; needed: one value per pixel"),
        (read_depth, "a b.npy", np.ones((5, 24, 32)), "a stack of 5 maps; .* Write each map to"),
        (read_depth, "a b.npy", np.eye(24) * np.arange(3)[:, None, None], "nor a stack of maps"),
        (read_normals, "a b.npy", np.ones((2, 24, 32, 3)), "a stack of 2 maps"),
        (read_depth, "a b.npz", ONES[0, 0], "contains normals, albedo; .* array .* named depth"),
    ],
)
def test_invalid_or_mismatching_maps_are_refused(read, name, values, message, views, tmp_path):
    if values.dtype.kind in "UO" or name.endswith(".txt"):
        with (tmp_path / name).open("wb") as file:
            np.save(file, values)
    else:
        save(tmp_path / name, values)
    with pytest.raises(InputError, match=message):
        read(tmp_path, views)


def test_missing_folders_archives_and_standard_errors_are_refused(views, normals, tmp_path):
    with pytest.raises(InputError, match="found nothing; needed: a folder of maps"):
        read_normals(tmp_path / "none", views)
    (tmp_path / "a b.npz").write_bytes(b"no archive")
    with pytest.raises(InputError, match=r"a b.npz: cannot be read: it is not a NumPy archive"):
        read_depth(tmp_path, views)
    save(tmp_path / "a b.npz", normals)
    with pytest.raises(ConfigError, match="error_deg is 0"):
        read_normals(tmp_path, views, error_deg=0)
    (tmp_path / "a b.npz").unlink()
    save(tmp_path / "a b.npy", normals[..., 0])
    with pytest.raises(ConfigError, match="error is -1"):
        read_depth(tmp_path, views, error=-1)
