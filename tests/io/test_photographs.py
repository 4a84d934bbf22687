import shutil
import struct
import time
import tracemalloc
import warnings
import zlib

import numpy as np
import pytest
import torch
from photographs import save_image as save
from PIL import Image
from torch.nn.functional import avg_pool2d
from torch.testing import assert_close

from pimper_torch.io.photographs import load_views
from pimper_torch.radiometry import LINEAR, linear_from_srgb
from pimper_torch.runtime.errors import InputError, PimperWarning
from pimper_torch.runtime.events import Progress
from pimper_torch.runtime.stream import collected
from pimper_torch.stages.sfm.lenses import choose_lenses


def test_photographs_are_read_in_natural_order_as_linear_radiance(photos, pixels):
    views = load_views(photos)
    assert views.names == ("1.png", "2.png", "10.png")
    assert views.images.shape == (3, 3, 8, 12)
    assert views.sizes_px.tolist() == [[12, 8]] * 3
    assert views.masks is None
    assert views.focals_px.isnan().all()
    stored = torch.from_numpy(pixels / 255).permute(2, 0, 1)
    assert_close(views.images[0].double(), linear_from_srgb(stored), rtol=0, atol=1e-6)
    assert_close(load_views(photos, encoding=LINEAR).images[1].double(), stored, rtol=0, atol=1e-6)


def test_warning_filters_survive_decoding_in_threads(photos):
    filters = list(warnings.filters)
    load_views(photos)
    assert warnings.filters == filters


def test_other_and_hidden_files_are_skipped(photos):
    (photos / "notes.txt").write_text("notes")
    (photos / "._1.png").write_bytes(b"what a Mac leaves behind")
    (photos / "settings").mkdir()
    assert load_views(str(photos)).num_views == 3


def test_skipped_photograph_like_files_are_named_and_counted(photos, pixels):
    save(photos / "more" / "4.png", pixels)
    for name in ("5.gif", "1.HEIC", "2.heic", "8.avif", "10.CR2", "11.mp4"):
        (photos / name).write_bytes(b"")
    (photos / "12.jpg").symlink_to(photos / "nowhere.jpg")
    with pytest.warns(PimperWarning, match=r"\(1\)") as caught:
        assert load_views(photos).num_views == 3
    assert len(caught) == 1
    text = str(caught[0].message)
    kinds = ("GIF (1)", "HEIC (2)", "AVIF (1)", "CR2 (1)", "MP4 (1)")
    assert all(kind in text for kind in (*kinds, "broken link (1)", "folder of images (1)"))


def test_grey_photographs_have_one_channel_unless_one_is_coloured(photos, pixels):
    for name in ("1.png", "2.png", "10.png"):
        save(photos / name, pixels[..., 0])
    assert load_views(photos).images.shape[1] == 1
    save(photos / "3.png", pixels)
    with pytest.warns(PimperWarning, match="grey photographs among coloured ones"):
        images = load_views(photos).images
    assert images.shape[1] == 3
    assert torch.equal(images[0, 0], images[0, 2])


def test_different_sizes_are_padded_on_the_right_and_below(photos, pixels):
    save(photos / "2.png", pixels.swapaxes(0, 1).copy())
    views = load_views(photos)
    assert views.images.shape[-2:] == (12, 12)
    assert views.sizes_px.tolist() == [[12, 8], [8, 12], [12, 8]]
    assert (views.images.amax(dim=1)[~views.inside] == 0).all()
    assert_close(views.images[1, :, :, :8], views.images[0, :, :8].mT)


def test_photographs_of_different_digital_zooms_share_no_camera_model(tmp_path, pixels):
    for number, zoom in enumerate([1, 1, 2, 2]):
        exif = Image.Exif()
        exif[274] = 1
        exif.get_ifd(0x8769).update({0x920A: 4.0, 0xA404: float(zoom), 0xA405: 28 * zoom})
        save(tmp_path / f"{number}.png", pixels, exif=exif)
    wide = 28 / np.hypot(36, 24) * np.hypot(12, 8)
    views = load_views(tmp_path)
    assert views.focals_px.tolist() == pytest.approx([wide, wide, 2 * wide, 2 * wide])
    assert choose_lenses(views) == [0, 0, 1, 1]
    assert load_views(tmp_path, max_size_px=6).focals_px.tolist() == (views.focals_px / 2).tolist()


def test_shrinking_averages_radiance_and_scales_the_focal_length(tmp_path):
    stripes = np.zeros((64, 96, 3), dtype=np.uint8)
    stripes[:, ::2] = 200
    exif = Image.Exif()
    exif[274] = 1
    exif.get_ifd(0x8769)[0xA405] = 50
    for number in range(3):
        save(tmp_path / f"{number}.png", stripes, exif=exif)
    views = load_views(tmp_path, max_size_px=24)
    assert views.images.shape[-2:] == (16, 24)
    # Half the light; decimation would give 0 or 1, averaging the codes a fifth.
    half = float(linear_from_srgb(torch.tensor(200 / 255)) / 2)
    assert_close(views.images[..., 1:-1], torch.full((3, 3, 16, 22), half), rtol=0, atol=1e-4)
    assert views.focals_px[0].item() == pytest.approx(5000 / 3600 * 24)


def test_shrinking_keeps_corners_in_place(photos):
    ramp = np.tile(np.arange(0, 240, 5, dtype=np.uint8)[None, :, None], (32, 1, 3))
    for name in ("1.png", "2.png", "10.png"):
        save(photos / name, ramp)
    found = load_views(photos, encoding=LINEAR, max_size_px=12).images
    wanted = avg_pool2d(load_views(photos, encoding=LINEAR).images, 4)
    assert_close(found[..., 1:-1], wanted[..., 1:-1])  # the filter keeps inner ramps


def test_small_photographs_are_not_resized(photos):
    assert torch.equal(load_views(photos, max_size_px=12).images, load_views(photos).images)
    with pytest.raises(InputError, match="max_size_px is -1"):
        load_views(photos, max_size_px=-1)


def test_reading_reports_progress(photos):
    with collected(Progress) as heard:
        load_views(photos)
    assert heard == [Progress(done=done, total=3) for done in (1, 2, 3)]


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("nowhere", "nowhere: found nothing; needed: a folder"),
        ("a.png", r"a\.png: found a file; needed: a folder"),
        ("empty", r"no images; it is empty.*\.jpg.*\.tiff"),
        ("gif", r"no images; it contains a\.gif"),
        ("clip.MP4", r"clip\.MP4: is a video; .*`pimper frames .*clip\.MP4"),
        ("film", r"clip\.MP4: is a video; .*`pimper frames .*clip\.MP4"),
        ("photos", "found 2 .*needed: at least 3"),
    ],
)
def test_an_invalid_folder_of_photographs_is_refused(tmp_path, photos, name, why):
    for file in ("a.png", "gif/a.gif", "clip.MP4", "film/clip.MP4", "empty/.hidden"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_bytes(b"ftyp")
    (photos / "10.png").unlink()
    with pytest.raises(InputError, match=why):
        load_views(tmp_path / name)


def test_photographs_with_the_same_stem_are_refused(photos, pixels):
    save(photos / "2.jpg", pixels)
    with pytest.raises(InputError, match=r"2\.(jpg|png) and 2\.(jpg|png) differ only in"):
        load_views(photos)


def test_a_black_photograph_is_removed_by_name(photos, pixels):
    masks = photos.parent / "masks"
    for name in ("1", "2", "3", "10"):
        save(masks / f"{name}.png", pixels[..., 0])
    save(photos / "3.png", pixels)
    save(photos / "2.png", np.full((16, 12, 3), 2, dtype=np.uint8))
    save(masks / "2.png", np.zeros((16, 12), np.uint8))  # its mask is empty
    with pytest.warns(
        PimperWarning, match=r"1 of 4 photographs \(2\.png\) are completely black.*skipped"
    ):
        views = load_views(photos, masks=masks)
    (photos / "2.png").unlink()
    plain = load_views(photos, masks=masks)
    assert views.names == plain.names == ("1.png", "3.png", "10.png")
    assert torch.equal(views.images[..., :8, :], plain.images)
    assert torch.equal(views.masks[..., :8, :], plain.masks)
    assert torch.equal(views.sizes_px, plain.sizes_px)


@pytest.mark.parametrize("count", [1, 4])
def test_a_folder_with_too_few_usable_photographs_is_refused(photos, count):
    for index in range(count):
        save(photos / f"{index + 2}.png", np.full((8, 12, 3), 2, dtype=np.uint8))
    with pytest.raises(InputError, match=r"2\.png.*are completely black; needed: at least 3 photo"):
        load_views(photos)


def test_symbolic_links_are_followed(photos, tmp_path, pixels):
    save(tmp_path / "elsewhere.png", 255 - pixels)
    (photos / "3.png").symlink_to(tmp_path / "elsewhere.png")
    views = load_views(photos, encoding=LINEAR)
    assert views.names == ("1.png", "2.png", "3.png", "10.png")
    stored = torch.from_numpy(1 - pixels / 255).permute(2, 0, 1)
    assert_close(views.images[2].double(), stored, rtol=0, atol=1e-6)


@pytest.mark.parametrize("mode", ["L", "RGB"])
def test_a_huge_image_among_small_ones_is_refused_before_decoding(photos, mode):
    Image.new(mode, (13_000, 2_000)).save(photos / "3.png")
    data = bytearray((photos / "3.png").read_bytes())
    data[20:24] = struct.pack(">I", 13_000)  # the header claims more than the file contains
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    (photos / "3.png").write_bytes(data)
    tracemalloc.start()
    begin = time.perf_counter()
    with pytest.raises(InputError, match=r"3\.png: .*13000 x 13000 pixels"):
        load_views(photos)
    assert time.perf_counter() - begin < 0.5
    assert tracemalloc.get_traced_memory()[1] < 2e7
    tracemalloc.stop()


def test_one_photograph_much_larger_than_the_others_is_refused_or_shrunk(tmp_path):
    for index in range(7):
        save(tmp_path / f"{index}.jpg", np.full((300, 400, 3), 99, dtype=np.uint8))
    save(tmp_path / "7.jpg", np.full((2400, 3200, 3), 99, dtype=np.uint8))
    wanted = r"7\.jpg: has 3200 x 2400 .*median is 400 x 300; .*`--max-size-px 400`"
    with pytest.raises(InputError, match=wanted):
        load_views(tmp_path)
    assert load_views(tmp_path, max_size_px=400).sizes_px.tolist() == [[400, 300]] * 8


def test_padding_does_not_make_a_photograph_black(photos):
    dim = np.zeros((8, 12, 3), dtype=np.uint8)
    dim[:2, :2] = 200, 190, 180
    save(photos / "2.png", dim)
    save(photos / "3.png", np.full((300, 300, 3), (99, 90, 80), dtype=np.uint8))
    assert load_views(photos).num_views == 4


def test_a_grey_photograph_among_coloured_ones_is_named(tmp_path, pixels):
    grey = np.asarray(Image.fromarray(pixels).convert("L"))
    for name, image in (("1.png", pixels), ("2.png", grey), ("3.png", pixels)):
        save(tmp_path / name, image)
    with pytest.warns(PimperWarning, match=r"falsify the colours of albedo and light: 2\.png\. "):
        load_views(tmp_path)
    for name in ("1.png", "3.png"):
        save(tmp_path / name, grey)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_views(tmp_path)


def test_each_subfolder_has_the_photographs_of_one_pose(tmp_path, pixels):
    names = [f"pose_{pose}/light_{light}.png" for pose in (1, 2, 10) for light in (1, 2)]
    for name in reversed(names):
        save(tmp_path / "photos" / name, pixels)
        save(tmp_path / "masks" / name, pixels[..., 0])
    with pytest.warns(PimperWarning, match="6 photographs in its 3 folders are interpreted as 3"):
        views = load_views(tmp_path / "photos", masks=tmp_path / "masks")
    assert views.names == tuple(names)
    assert views.poses.tolist() == [0, 0, 1, 1, 2, 2]
    for pose in (1, 2, 10):
        save(tmp_path / "shared" / f"pose_{pose}.png", pixels[..., 0])
        save(tmp_path / "inside" / f"pose_{pose}" / "all.png", pixels[..., 0])
    for folder in ("shared", "inside"):
        with pytest.warns(PimperWarning, match="3 camera poses"):
            one_a_pose = load_views(tmp_path / "photos", masks=tmp_path / folder)
        assert torch.equal(one_a_pose.masks, views.masks)


@pytest.mark.parametrize(
    "beside", ["masks", "Mask", "silhouettes", "normals", "depth", "object_masks", "jar mask"]
)
def test_a_subfolder_of_masks_or_maps_is_not_a_pose(tmp_path, pixels, beside):
    for pose in (1, 2, 3):
        save(tmp_path / f"pose_{pose}" / "1.png", pixels)
        save(tmp_path / beside / f"pose_{pose}.png", pixels[..., 0])
    with pytest.warns(PimperWarning) as caught:
        views = load_views(tmp_path, masks=tmp_path / beside)
    assert views.names == tuple(f"pose_{pose}/1.png" for pose in (1, 2, 3))
    assert views.poses.tolist() == [0, 1, 2]
    passed = [str(one.message) for one in caught if "were not read" in str(one.message)]
    assert len(passed) == 1
    assert f"folder of images (1); {beside}." in passed[0]
    shutil.rmtree(tmp_path / "pose_3")
    with pytest.raises(InputError, match="no images"):
        load_views(tmp_path)


def test_poses_of_a_mask_that_was_photographed_are_poses(tmp_path, pixels):
    names = tuple(f"{pose}_mask/1.png" for pose in ("back", "front", "left"))
    for name in names:
        save(tmp_path / name, pixels)
    with pytest.warns(PimperWarning, match="3 camera poses"):
        assert load_views(tmp_path).names == names


def test_two_subfolders_are_not_poses(tmp_path, pixels):
    for name in ("a/1.png", "a/2.png", "b/1.png", "b/2.png"):
        save(tmp_path / name, pixels)
    with pytest.raises(InputError, match=r"no images; it contains .*at least three subfolders"):
        load_views(tmp_path)
    save(tmp_path / "c" / "1.png", pixels)
    save(tmp_path / "c" / "1.tif", pixels)
    with pytest.raises(InputError, match=r"c: 1.png and 1.tif differ only in their suffix"):
        load_views(tmp_path)


def test_a_folder_is_named_by_the_given_path(photos, tmp_path, monkeypatch):
    (tmp_path / "cam1").symlink_to(photos)
    monkeypatch.chdir(photos)
    assert load_views(".").folder == photos.as_posix()
    assert load_views("../cam1").folder == (tmp_path / "cam1").as_posix()
