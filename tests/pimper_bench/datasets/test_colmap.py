import pytest
from torch.testing import assert_close

from pimper_bench.datasets import read_colmap
from pimper_torch.runtime.errors import InputError

# `hand_camera` as a quaternion: a third of a turn about (-1, -1, -1), w = 0.5.
POSE = "0.5 -0.5 -0.5 -0.5 -2 -3 4"


@pytest.fixture
def folder(tmp_path, paint):
    """A text model in sparse/0 next to images, one of which is in a subfolder."""
    for name in ("a.png", "left/b.png", "c.png"):
        paint(tmp_path / "images" / name, 100)
    write_text(tmp_path / "sparse" / "0")
    return tmp_path


def write_text(model, second="left/b.png", camera="1 PINHOLE 16 12 20 30 7 5"):
    model.mkdir(parents=True, exist_ok=True)
    (model / "cameras.txt").write_text(camera + "\n")
    seen = [("a.png", "9 11 1 3 4 -1"), (second, "9.5 11 1"), ("c.png", "9 11 1")]
    lines = [f"{number} {POSE} 1 {name}\n{at}\n" for number, (name, at) in enumerate(seen, 1)]
    (model / "images.txt").write_text("".join(lines))
    (model / "points3D.txt").write_text("1 6 3 5 255 0 0 0.25 1 0 2 0 3 0\n")


def test_a_text_model_is_read_with_its_photographs(folder, sees, hand_camera):
    capture = read_colmap(folder)
    assert capture.views.names == ("a.png", "left/b.png", "c.png")
    assert sees(capture) == pytest.approx([9, 11])
    assert_close(capture.cameras.cam_from_world[1], hand_camera)
    assert capture.truth.points_world is None  # triangulated, not measured


def test_a_path_to_the_model_is_accepted_and_masks_are_next_to_it(folder, paint, sees):
    paint(folder / "masks" / "a.png.png", 0)
    paint(folder / "masks" / "b.png", 0)
    paint(folder / "masks" / "c-mask.png", 0)
    capture = read_colmap(folder / "sparse" / "0", names=["left/b.png"])
    assert sees(capture) == pytest.approx([9, 11])
    assert capture.views.masks.sum() == 48


def test_photographs_may_be_in_a_different_folder(folder, sees):
    (folder / "images").rename(folder / "pictures")
    with pytest.raises(InputError, match="a folder `images`"):
        read_colmap(folder)
    assert sees(read_colmap(folder, images=folder / "pictures")) == pytest.approx([9, 11])


@pytest.mark.parametrize(
    ("spoil", "needed"),
    [
        (lambda at: write_text(at / "sparse" / "0", second="../secret.png"), "leads out of it"),
        (lambda at: (at / "images" / "a.png").unlink(), r"no a\.png"),
        (lambda at: (at / "sparse").rename(at / "dense"), r"cameras\.bin or cameras\.txt"),
    ],
)
def test_read_colmap_refuses_outside_paths_and_missing_files(folder, paint, spoil, needed):
    paint(folder / "secret.png", 100)
    spoil(folder)
    with pytest.raises(InputError, match=needed):
        read_colmap(folder)
