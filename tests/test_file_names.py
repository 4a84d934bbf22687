import unicodedata

import pytest

from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.file_names import match_files, match_poses


def matched(wanted, present, folder=""):
    return match_files(wanted, present, folder=folder, where="model", what="image")


@pytest.mark.parametrize(
    ("wanted", "present"),
    [
        ("IMG 1.jpg", "IMG 1.jpg"),
        ("IMG 1.jpg", "IMG_1.jpg"),
        ("IMG  1.jpg", "IMG 1.jpg"),
        ("IMG 1.jpg", "IMG%201.jpg"),
        ("IMG 1.jpg", '"IMG 1.jpg"'),
        ("IMG_1.JPG", "img_1.jpg"),
        ("a.jpg", "images\\a.jpg"),
        ("a.jpg", "C:\\shots\\a.jpg"),
        ("a.jpg", "./a.jpg"),
        (
            unicodedata.normalize("NFC", "Häuschen.jpg"),
            unicodedata.normalize("NFD", "Häuschen.jpg"),
        ),
        (unicodedata.normalize("NFD", "éÅ.jpg"), unicodedata.normalize("NFC", "éÅ.jpg")),
        ("STRASSE.jpg", "straße.jpg"),
        ("a.jpg", "a.png"),
        ("a.tif", "a"),
        ("a.png", "A.JPG.png"),
        ("a.v2.jpg", "a.v2.tiff"),
    ],
)
def test_rewritten_file_names_match(wanted, present):
    assert matched([wanted], ["other.jpg", present]) == [1]
    assert matched([present.rpartition("/")[2]], ["x/y.jpg", wanted]) == [1]


@pytest.mark.parametrize(
    ("wanted", "present"),
    [
        ("a.jpg", "b.jpg"),
        ("1.jpg", "01.jpg"),
        ("a.v2.jpg", "a.jpg"),
        ("a.jpg", "a-1.jpg"),
        ("ab.jpg", "a b.jpg"),
    ],
)
def test_different_file_names_do_not_match(wanted, present):
    assert matched([wanted], [present]) == [None]


def test_exact_names_take_precedence():
    present = ["a b.jpg", "a_b.jpg", "A_B.jpg", "a_b.png"]
    assert matched(["a_b.jpg", "a b.jpg", "a_b.png", "A_B.jpg"], present) == [1, 0, 3, 2]


CAMS = ["cam1/000.png", "cam2/000.png", "cam1/001.png", "cam2/001.png"]


@pytest.mark.parametrize(
    ("wanted", "present", "folder", "places"),
    [
        (["000.png", "001.png"], CAMS, "/data/cam1", [0, 2]),
        (["000.png", "001.png"], CAMS, "/data/cam2", [1, 3]),
        (["000.png", "001.png"], CAMS, "C:\\data\\CAM2", [1, 3]),
        (["cam2/001.png", "cam1/001.png"], CAMS, "/data/photos", [3, 2]),
        (["0.png"], ["left/cam1/0.png", "right/cam1/0.png"], "/left/right/cam1", [1]),
        (["0.png"], ["cam1/0.png", "0.png"], "/data/photos", [1]),
        # Files of a different folder are ignored if any are in the photographs' folder.
        (["000.png", "001.png"], ["cam1/000.png", *CAMS[1::2]], "/data/cam1", [0, None]),
        (["001.png"], ["cam1/000.png", *CAMS[1::2]], "/data/photos", [2]),
    ],
)
def test_trailing_folders_resolve_ambiguous_names(wanted, present, folder, places):
    assert matched(wanted, present, folder) == places


@pytest.mark.parametrize(
    ("wanted", "present"),
    [
        (["000.png"], ["cam1/000.png", "cam2/000.png"]),
        (["a.jpg"], ["A.jpg", "a.JPG"]),
        (["A.jpg"], ["a.png", "a.tif"]),
        (["a b.jpg"], ["a_b.jpg", "a%20b.jpg"]),
    ],
)
def test_an_ambiguous_name_is_refused_with_all_candidates(wanted, present):
    with pytest.raises(InputError, match=rf"^model: {wanted[0]} may be any of ") as caught:
        matched(wanted, present, "/data/photos")
    assert all(name in str(caught.value) for name in present)


def test_two_photographs_that_match_one_image_are_refused_with_both():
    with pytest.raises(InputError, match=r"A\.jpg may be any of a\.jpg, a\.JPG"):
        matched(["a.jpg", "a.JPG"], ["A.jpg"])


def test_an_exactly_matched_image_is_assigned_only_once():
    assert matched(["a.jpg", "A.jpg"], ["a.jpg"]) == [0, None]


PHOTOGRAPHS = ["p1/a.jpg", "p1/b.jpg", "p2/a.jpg", "p2/b.jpg"]


@pytest.mark.parametrize(
    ("present", "places"),
    [
        (["p1/b.jpg", "p2/a.jpg"], [0, 0, 1, 1]),
        (["p2.png", "p1.png"], [1, 1, 0, 0]),
        (["x/p2/mean.png", "x/p1/mean.png"], [1, 1, 0, 0]),
        (["p1/b.jpg", "p1.png", "p1/a.jpg"], [2, 0, None, None]),  # its own file takes precedence
        (["p1/b.jpg", "p1.png"], [0, 0, None, None]),
        (["p1/c.jpg", "p1/d.jpg", "P2.JPG"], [None, None, 2, 2]),  # two files of one pose
        (["p2/a.jpg"], [None, None, 0, 0]),
        (["p3/a.jpg", "p1/a.jpg", "p3/b.jpg"], [1, 1, None, None]),
    ],
)
def test_a_missing_file_is_replaced_by_that_of_the_same_pose(present, places):
    assert match_poses(PHOTOGRAPHS, present, where="model", what="image") == places


def test_photographs_without_folders_have_no_pose():
    assert match_poses(["a.jpg", "b.jpg"], ["a.jpg"], where="model", what="image") == [0, None]
