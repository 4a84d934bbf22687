"""Matching of map files to photographs."""

import numpy as np
import pytest
import torch
from sparse_models import views_of

from pimper_torch.priors.prior_files.folder import read_maps
from pimper_torch.runtime.errors import InputError

KINDS = {"normal": ("normal",), "depth": ("depth",), "mask": ("mask",)}
FLAT = ("cup_1.jpg", "cup_2.jpg")
POSES = ("p_1/a.png", "p_1/b.png", "p_2/a.png", "p_2/b.png")


def numbers_of(folder, names, kind="depth"):
    """Return the number in the map of each photograph that has one."""
    views = views_of(torch.zeros(len(names), 3, 4, 6), names=names)
    maps = read_maps(folder, views, KINDS[kind], lambda _, layer: layer.values, undistorted=False)
    return dict(zip(maps.names, maps.values[:, 0, 0, 0].int().tolist(), strict=True))


def write(folder, files):
    """Write maps that contain their index in the list."""
    for number, file in enumerate(files):
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        np.save(folder / file, np.full((4, 6), number, np.float32), allow_pickle=False)


@pytest.mark.parametrize("kind", KINDS)
def test_the_requested_kind_of_maps_is_read_from_a_mixed_folder(kind, tmp_path):
    """As written by MoGe (a folder per photograph) and by programs that append the kind."""
    kinds = ("depth", "depth_vis", "mask", "normal")
    layouts = "cup_{}/{}.npy", "cup_{}_{}.npy", "{1}/cup_{0}.npy", "cup_{}-pred_{}.npy"
    for layout in (*layouts, "cup_{}_pred/{}.npy"):
        folder = tmp_path / layout.replace("/", " in ")
        write(folder, [layout.format(name, of) for name in (1, 2) for of in kinds])
        number = kinds.index(kind)
        assert numbers_of(folder, FLAT, kind) == dict(zip(FLAT, (number, number + 4), strict=True))


def test_other_files_of_moge_are_not_unmatched_maps(tmp_path):
    write(tmp_path, ["cup_2/depth.npy", "cup_2/image.npy", "cup_2/points.npy"])
    assert numbers_of(tmp_path, FLAT) == {"cup_2.jpg": 0}
    write(tmp_path, ["cup_2/depth.npy", "cup_3/depth.npy"])
    with pytest.raises(InputError, match=r"no map for cup_1\.jpg, .* for cup_3/depth\.npy"):
        numbers_of(tmp_path, FLAT)


ONE_A_PHOTOGRAPH = dict(zip(POSES, range(4), strict=True))
ONE_PER_POSE = {"p_1/a.png": 0, "p_2/a.png": 1}  # the first represents its pose


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        (["p_1/a.npy", "p_1/b.npy", "p_2/a.npy", "p_2/b.npy"], ONE_A_PHOTOGRAPH),
        (["p_1/a_depth.npy", "p_1/b.npy", "p_2/a.npy", "p_2/b.npy"], ONE_A_PHOTOGRAPH),
        ([f"{name[:-4]}/depth.npy" for name in POSES], ONE_A_PHOTOGRAPH),
        (["p_1_a.npy", "p_1_b.npy", "p_2_a.npy", "p_2_b.npy"], ONE_A_PHOTOGRAPH),
        (["p_1-a_depth.npy", "p_1-b.npy", "p_2-a.npy", "p_2-b.npy"], ONE_A_PHOTOGRAPH),
        (["p_1.npy", "p_2.npy"], ONE_PER_POSE),
        (["p_1_depth.npy", "p_2_depth.npy", "p_1_normal.npy", "p_2_normal.npy"], ONE_PER_POSE),
        (["p_1/depth.npy", "p_2/depth.npy", "p_1/normal.npy", "p_2/normal.npy"], ONE_PER_POSE),
        (["p_1/mean.npy", "p_2/mean.npy"], ONE_PER_POSE),
        (["p_1/b.npy", "p_2.npy"], ONE_PER_POSE),
        (["p_1/b.npy", "p_2/b.npy"], ONE_PER_POSE),
        (["p_2/b.npy"], {"p_2/a.png": 0}),
    ],
)
def test_flat_or_nested_maps_are_matched_per_pose_or_photograph(files, expected, tmp_path):
    write(tmp_path, files)
    assert numbers_of(tmp_path, POSES) == expected


def test_subfolders_do_not_change_the_maps_of_a_flat_folder(tmp_path):
    write(tmp_path, ["cup_1.npy", "old/cup_1.npy", "cup_1/depth.npy", "old/cup_2.npy"])
    assert numbers_of(tmp_path, FLAT) == {"cup_1.jpg": 0}


def test_photographs_named_like_maps_keep_their_names(tmp_path):
    names = ("a_depth.jpg", "a_normal.jpg", "mask.jpg")
    write(tmp_path, ["a_depth.npy", "a_normal.npy", "mask.npy"])
    assert numbers_of(tmp_path, names) == dict(zip(names, range(3), strict=True))


def test_a_folder_with_only_one_kind_of_map_is_read_with_any_name(tmp_path):
    write(tmp_path, ["cup_1_normal.npy", "cup_2_normal.npy"])
    assert numbers_of(tmp_path, FLAT) == dict(zip(FLAT, range(2), strict=True))


def test_a_multipage_file_and_a_file_instead_of_a_folder_are_refused(tmp_path):
    (tmp_path / "stack.tif").write_bytes(b"pages")
    with pytest.raises(InputError, match=r"It contains stack\.tif. Write pages of a TIFF to"):
        numbers_of(tmp_path, FLAT)
    with pytest.raises(InputError, match="found a file; needed: a folder of maps, one per photo"):
        numbers_of(tmp_path / "stack.tif", FLAT)
