import json

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from pimper_torch.export.map_files import with_axes, write_maps
from pimper_torch.export.picture_files import file_names, refuse_skew
from pimper_torch.io.decode import decode
from pimper_torch.io.openexr import write_exr
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.numpy_files import read_npz
from pimper_torch.viz.maps import view_maps


@pytest.mark.parametrize("shape", [(37, 53, 3), (37, 53, 1), (1, 1, 1), (16, 5, 3), (33, 4, 1)])
def test_exr_maps_are_read_back_bit_for_bit(shape, tmp_path, read_exr):
    values = np.random.default_rng(7).normal(size=shape).astype(np.float32)
    values[: shape[0] // 2] = 0  # compressible, unlike the noise
    write_exr(values, tmp_path / "x.exr", "what it means")
    assert np.array_equal(read_exr(tmp_path / "x.exr").reshape(shape), values)
    assert b"what it means" in (tmp_path / "x.exr").read_bytes()


@pytest.mark.parametrize(
    ("axes", "right", "down", "facing"),
    [
        ("opencv", [1, 0, 0], [0, 1, 0], [0, 0, -1]),
        ("opengl", [1, 0, 0], [0, -1, 0], [0, 0, 1]),
        ("lub", [-1, 0, 0], [0, -1, 0], [0, 0, 1]),
    ],
)
def test_axes_agree_with_their_names(axes, right, down, facing):
    ours = torch.tensor([[[1.0, 0, 0], [0, 1, 0], [0, 0, -1]]])
    assert with_axes(ours, axes).tolist() == [[right, down, facing]]


@pytest.mark.parametrize("axes", ["opencv", "opengl", "lub"])
def test_every_file_has_the_maps_of_its_view(axes, result, tmp_path, read_exr):
    write_maps(result, tmp_path, axes)
    assert json.loads((tmp_path / "README.json").read_text())["axes"] == axes
    for view, stem in enumerate("abc"):
        maps = view_maps(result.mesh, result.scene.cameras, view)
        normals = with_axes(maps.normals_cam, axes)
        assert np.array_equal(read_exr(tmp_path / "normals" / f"{stem}.exr"), normals)
        depth = read_exr(tmp_path / "depth" / f"{stem}.exr")
        assert np.array_equal(depth, maps.depth.nan_to_num(0).numpy())
        assert np.array_equal(read_exr(tmp_path / "albedo" / f"{stem}.exr"), maps.albedo.numpy())
        arrays = read_npz(tmp_path / "arrays" / f"{stem}.npz")  # does not load pickles
        assert np.array_equal(arrays["normals"], normals)
        assert np.array_equal(arrays["depth"], maps.depth.numpy(), equal_nan=True)
        assert np.array_equal(arrays["mask"], maps.seen.numpy())
        assert np.array_equal(arrays["intrinsics"], result.cameras.intrinsics[view].numpy())
        assert np.array_equal(arrays["cam_from_world"], result.cameras.cam_from_world[view].numpy())
        assert (str(arrays["axes"]), str(arrays["name"])) == (axes, f"{stem}.png")


def test_sixteen_bit_normals_are_exact_to_half_a_level(result, tmp_path):
    write_maps(result, tmp_path, "opengl")
    png = decode(tmp_path / "normals" / "b.png")
    assert png.bits == 16
    maps = view_maps(result.mesh, result.scene.cameras, 1)
    found = (2 * png.samples - 1).movedim(0, -1)[maps.seen]
    expected = torch.from_numpy(with_axes(maps.normals_cam, "opengl"))[maps.seen]
    # Half a level of 65,535 for a range of two, and float32's rounding in both directions.
    assert_close(found, expected, rtol=0, atol=1.02 / 65535)
    assert (png.samples[:, ~maps.seen] == 0).all()


def test_file_names_are_unique_and_stay_in_the_folder():
    names = ["a.jpg", "a.png", "../b.png", "/c/b.png", "c\\d.tif", "a_jpg.png"]
    files = file_names(names)
    assert len(set(files)) == len(names)
    assert not any("/" in file or "\\" in file or ".." in file for file in files)
    assert all(file.endswith(".png") for file in files)


def test_a_skew_that_moves_pixels_is_refused_and_rounding_is_not(reconstruction):
    cameras, names = reconstruction.cameras, reconstruction.scene.views.names
    K = cameras.intrinsics.clone()
    K[1, 0, 1] = 1e-2  # times half of 40 pixels, divided by a focal length of 90
    refuse_skew(cameras.replace(intrinsics=K), names, "a toy")
    K[1, 0, 1] = 0.1
    with pytest.raises(InputError, match=r"b\.png have a skew"):
        refuse_skew(cameras.replace(intrinsics=K), names, "a toy")
