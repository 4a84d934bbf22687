from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from photographs import photographed
from PIL import Image
from torch.testing import assert_close

from pimper_bench.datasets import (
    read_colmap,
    read_idr,
    read_transforms,
    write_colmap,
    write_idr,
    write_transforms,
)
from pimper_bench.datasets.posed import (
    PosedPhotograph,
    assemble,
    image_files,
    mask_finder,
)
from pimper_torch.geometry.lens_models import distort
from pimper_torch.geometry.projection import project
from pimper_torch.io.cameras.layout import DataSetPath
from pimper_torch.radiometry import LINEAR
from pimper_torch.records import CameraModel
from pimper_torch.runtime.errors import InputError

LENS = CameraModel(camera=1, model="PINHOLE", params=(20.0, 30.0, 7.0, 5.0), width=16, height=12)


def put(shots, folder, **options):
    return assemble(shots, DataSetPath(folder, "a toy"), **options)


@pytest.fixture
def shot(tmp_path, paint, hand_camera):
    """Make a photograph of the camera computed by hand."""

    def make(name: str = "a.png", width: int = 16, height: int = 12, **more) -> PosedPhotograph:
        paint(tmp_path / name, 100, width, height)
        if "mask" in more:
            more["mask"] = tmp_path / more["mask"]
        fields = {"lens": LENS, "cam_from_world": hand_camera} | more
        return PosedPhotograph(name=name, image=tmp_path / name, **fields)

    return make


def test_the_camera_stays_with_its_photograph(shot, tmp_path, sees):
    capture = put([shot()], tmp_path)
    assert sees(capture) == pytest.approx([9, 11])
    assert capture.cameras.cam_from_world.dtype == torch.float64
    assert capture.views.images.dtype == torch.float32
    assert capture.views.masks is None
    # sRGB 120 of the brighter quarter and 100 of the rest, by the formula of IEC 61966-2-1.
    assert_close(float(capture.views.images[0, 0, 0, 0]), ((120 / 255 + 0.055) / 1.055) ** 2.4)
    assert_close(float(capture.views.images[0, 2, 11, 15]), ((100 / 255 + 0.055) / 1.055) ** 2.4)


@pytest.mark.parametrize("option", [{"max_size_px": 8}, {}])
def test_the_camera_is_scaled_with_its_photograph(shot, tmp_path, sees, option):
    small = shot() if option else shot(width=8, height=6)
    capture = put([small], tmp_path, **option)
    assert sees(capture) == pytest.approx([4.5, 5.5])
    assert capture.cameras.sizes_px.tolist() == [[8, 6]] == capture.views.sizes_px.tolist()


def test_the_skew_is_scaled_with_the_photograph(shot, tmp_path, sees):
    sheared = shot(skew_px=5.0)
    assert sees(put([sheared], tmp_path)) == pytest.approx([10, 11])
    small = put([sheared], tmp_path, max_size_px=8)
    assert sees(small) == pytest.approx([5, 5.5])


def test_names_select_and_order_photographs(shot, tmp_path):
    shots = [shot("a.png"), shot("b.png"), shot("c.png", skew_px=3.0)]
    capture = put(shots, tmp_path, names=["c.png", "a.png"])
    assert capture.views.names == ("c.png", "a.png")
    assert capture.cameras.intrinsics[:, 0, 1].tolist() == [3, 0]
    assert capture.position.tolist() == [0, 1] == capture.light.tolist()


def test_photographs_are_undistorted_to_the_pinhole_of_the_capture(tmp_path, hand_camera):
    lens = CameraModel(
        camera=1,
        model="OPENCV",
        params=(60.0, 62.0, 31.0, 24.5, -0.35, 0.05, 0.004, -0.007),
        width=64,
        height=48,
    )
    dot = torch.tensor([[6.0, 5.5, 6.0]], dtype=torch.float64)
    rays = dot @ hand_camera[:3, :3].T + hand_camera[:3, 3]
    at = distort(lens, rays)[0]
    rows, columns = np.mgrid[:48, :64] + 0.5
    bump = np.exp(-((columns - float(at[0])) ** 2 + (rows - float(at[1])) ** 2) / 3)
    Image.fromarray((250 * bump).round().astype(np.uint8)).save(tmp_path / "a.png")
    shot = PosedPhotograph(
        name="a.png", image=tmp_path / "a.png", lens=lens, cam_from_world=hand_camera
    )
    capture = put([shot], tmp_path, encoding=LINEAR)
    cameras = capture.cameras
    expected, _ = project(dot, cameras.cam_from_world[0], cameras.intrinsics[0])
    assert (expected - at).norm() > 1  # distortion has an effect
    image = capture.views.images[0, 0].double()
    v, u = torch.meshgrid(torch.arange(48) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    found = torch.stack([(u * image).sum(), (v * image).sum()]) / image.sum()
    assert_close(found, expected[0], rtol=0, atol=0.15)  # the bump is slightly stretched


def test_a_mask_of_a_different_size_is_resized_to_the_photograph(shot, tmp_path):
    drawn = np.zeros((6, 8), dtype=np.uint8)
    drawn[1:3, 4:7] = 1  # a label, not a brightness
    Image.fromarray(drawn).save(tmp_path / "m.png")
    masks = put([shot(mask="m.png")], tmp_path).views.masks
    expected = torch.zeros(12, 16, dtype=torch.bool)
    expected[2:6, 8:14] = True
    assert torch.equal(masks[0], expected)


def test_the_true_surface_is_kept(shot, tmp_path):
    (tmp_path / "true.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 2 0\nf 1 2 3\n")
    truth = put([shot()], tmp_path, mesh=tmp_path / "true.obj").truth
    assert truth.mesh.vertices_world.tolist() == [[0, 0, 0], [1, 0, 0], [0, 2, 0]]


def test_links_to_images_are_followed(tmp_path, paint):
    """A link to a file, a link to a link, and a linked folder."""
    paint(tmp_path / "elsewhere" / "deep" / "0.png", 100)
    folder = tmp_path / "set"
    folder.mkdir()
    (folder / "a.png").symlink_to(tmp_path / "elsewhere" / "deep" / "0.png")
    (folder / "b.png").symlink_to("a.png")
    (folder / "broken.png").symlink_to("nowhere.png")
    paint(folder / ".hidden.png", 100)
    (folder / "notes.txt").touch()
    (tmp_path / "whole").symlink_to(folder)
    for place in (folder, tmp_path / "whole"):
        names = [path.name for path in image_files(DataSetPath(place, "a toy"))]
        assert names == ["a.png", "b.png"]
    find = mask_finder(tmp_path / "whole", "a toy")
    assert find(tmp_path / "a.jpg") == tmp_path / "whole" / "a.png"


def test_a_rounded_rotation_is_made_exact(tmp_path):
    skew = torch.tensor([[0.0, -1, 2], [1, 0, 3], [-2, -3, 0]]).double()
    rotation = torch.linalg.matrix_exp(skew)
    rounded, place = (rotation * 1e4).round() / 1e4, DataSetPath(tmp_path, "a toy")
    exact = place.rigid(rounded, torch.ones(3).double(), "R")[:3, :3]
    assert_close(exact @ exact.T, torch.eye(3).double(), rtol=0, atol=1e-14)
    assert_close(exact, rotation, rtol=0, atol=1e-4)  # the rounding error


def test_masks_are_found_by_name(tmp_path, paint):
    for name in ("1.png", "10-cut.png", "2.jpg.png", "2_other.png", "4-a.png", "4-b.png"):
        paint(tmp_path / "m" / name, 100)
    find = mask_finder(tmp_path / "m", "a toy")
    photographs = [tmp_path / name for name in ("1.jpg", "10.jpg", "2.jpg")]
    assert [find(path).name for path in photographs] == ["1.png", "10-cut.png", "2.jpg.png"]
    for name, message in (("3.jpg", r"one mask for 3\.jpg"), ("4.jpg", r"4-a\.png, 4-b\.png")):
        with pytest.raises(InputError, match=message):
            find(tmp_path / name)
    assert mask_finder(None, "a toy")(tmp_path / "3.jpg") is None


def _black(path):
    Image.fromarray(np.zeros((12, 16), dtype=np.uint8)).save(path)
    return path


@pytest.mark.parametrize(
    ("shots", "options", "message"),
    [
        (
            [{}],
            {"names": ["d.png"]},
            r"d\.png requested; needed: any of its 1 photographs.*a\.png",
        ),
        ([{}], {"names": []}, r"no photographs requested; needed: any of its 1 photographs"),
        ([{}], {"names": ["a.png", "a.png"]}, r"a\.png, a\.png requested; needed.*each once"),
        ([{}], {"max_size_px": -1}, "max_size_px is -1"),
        ([{}, {}], {}, r"several a\.png"),
        ([{"width": 12, "height": 16}], {}, "12 x 16, but its camera is for 16 x 12"),
        ([{"mask": "m.png"}], {}, r"m\.png: marks no pixel"),
    ],
)
def test_mismatching_photographs_are_refused(shot, tmp_path, shots, options, message):
    _black(tmp_path / "m.png")
    made = [shot(**one) for one in shots]
    with pytest.raises(InputError, match=message):
        put(made, tmp_path, **options)


def test_a_missing_photograph_is_refused_if_it_is_requested(shot, tmp_path):
    shots = [shot("a.png"), shot("b.png")]
    (tmp_path / "b.png").unlink()
    with pytest.raises(InputError, match=r"no b\.png"):
        put(shots, tmp_path)
    assert put(shots, tmp_path, names=["a.png"]).views.num_views == 1


LAYOUTS = {
    "colmap": (write_colmap, read_colmap),
    "transforms": (write_transforms, read_transforms),
    "idr": (write_idr, read_idr),
}


@pytest.mark.parametrize("layout", LAYOUTS)
@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 2**31), skewed=st.booleans(), masked=st.booleans())
def test_an_export_survives_a_round_trip(layout, seed, skewed, masked):
    write, read = LAYOUTS[layout]
    views, cameras, points = photographed(seed, skewed, masked)
    with TemporaryDirectory() as folder:
        if skewed and layout != "idr":  # layouts without skew refuse it
            with pytest.raises(InputError, match="a skew"):
                write(views, cameras, Path(folder), points_world=points)
            return
        write(views, cameras, Path(folder), points_world=points)
        again = read(Path(folder))
    stems = [f"{index:03d}" if layout == "idr" else str(index) for index in range(views.num_views)]
    assert again.views.names == tuple(f"{stem}.png" for stem in stems)
    assert_close(again.views.images, views.images)
    shown = views.inside if views.masks is None else views.masks & views.inside
    if masked or layout == "idr":  # its programs require masks
        assert torch.equal(again.views.masks, shown)
    assert_close(again.cameras.intrinsics, cameras.intrinsics)
    assert_close(again.cameras.cam_from_world, cameras.cam_from_world)
    assert torch.equal(again.cameras.sizes_px, cameras.sizes_px)
