import pytest

from pimper_torch.export.picture_files import file_names, refuse_skew
from pimper_torch.runtime.errors import InputError


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
