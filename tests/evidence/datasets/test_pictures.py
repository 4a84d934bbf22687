import pytest

from pimper_torch.errors import InputError
from pimper_torch.evidence.datasets.pictures import file_names, refuse_skew


def test_no_two_photographs_get_one_file_and_none_leaves_the_folder():
    names = ["a.jpg", "a.png", "../b.png", "/c/b.png", "c\\d.tif", "a_jpg.png"]
    files = file_names(names)
    assert len(set(files)) == len(names)
    assert not any("/" in file or "\\" in file or ".." in file for file in files)
    assert all(file.endswith(".png") for file in files)


def test_a_skew_that_moves_pixels_is_refused_and_rounding_is_not(capture):
    K = capture.cameras.intrinsics.clone()
    K[1, 0, 1] = 1e-3  # times 4.5 / 19
    refuse_skew(capture.cameras.replace(intrinsics=K), capture.views.names, "a toy")
    K[1, 0, 1] = 0.1
    with pytest.raises(InputError, match=r"side/second\.tif have a skew"):
        refuse_skew(capture.cameras.replace(intrinsics=K), capture.views.names, "a toy")
