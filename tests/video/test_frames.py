"""Videos of a moving patterned plane, generated here."""

import json
from fractions import Fraction

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import gaussian_filter

from pimper_torch.cli.main import main
from pimper_torch.cli.video.choose import motion, scanned, sharpness, thumbnail
from pimper_torch.cli.video.read import frame_pictures, luma_frames
from pimper_torch.io.photograph_files import list_images
from pimper_torch.runtime.errors import PimperWarning
from tests.video.clips import COUNT, HEIGHT, WIDTH, positions, texture, written

PLAIN = "Convert it: ffmpeg -i clip.mkv -vf bwdif=0,scale=iw*sar:ih,setsar=1"


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return written(tmp_path_factory.mktemp("videos") / "clip.mp4")


def test_selected_frames_are_sharp_and_equally_spaced(tmp_path, capsys):
    video = written(tmp_path / "clip.mp4", blur=lambda number: 0.0 if number % 3 == 1 else 2.5)
    line = ["frames", str(video), "-o", str(tmp_path / "photos"), "--count", "12", "--json"]
    assert main(line) == 0
    *_, result = map(json.loads, capsys.readouterr().out.splitlines())
    assert result["photographs"] == 12
    assert result["frames"] == COUNT
    names = [path.name for path in list_images(tmp_path / "photos")]
    numbers = [int(name[:6]) for name in names]
    assert len(numbers) == 12
    assert sum(number % 3 == 1 for number in numbers) >= 11
    steps = np.diff(positions()[numbers])
    assert steps.min() > 0.4 * 500 / 12
    assert steps.max() < 1.6 * 500 / 12
    shown = np.asarray(Image.open(tmp_path / "photos" / names[5])).astype(float)
    at = positions()[numbers[5]]
    assert np.abs(shown - texture()[20 : 20 + HEIGHT, at : at + WIDTH]).mean() < 6


def test_duplicate_frames_are_not_written(tmp_path, capsys):
    clip = written(tmp_path / "rest.mp4", places=[12 * (number // 8) for number in range(40)])
    assert main(["frames", str(clip), "-o", str(tmp_path / "few"), "--count", "11"]) == 0
    assert len(list_images(tmp_path / "few")) == 5
    assert "has 5 different frames instead of 11" in capsys.readouterr().err


def test_changing_light_does_not_count_as_motion(clip, tmp_path):
    moving = scanned(luma_frames(clip))
    video = written(tmp_path / "b.mp4", gain=lambda number: 0.75 + 0.25 * np.sin(number / 9))
    lit = scanned(luma_frames(video))
    assert moving.way[-1] == pytest.approx(500 / WIDTH, rel=0.05)
    assert lit.way[-1] == pytest.approx(500 / WIDTH, rel=0.05)
    away = np.abs(moving.way.numpy() * WIDTH - positions()).max()
    assert away < 0.05 * 500


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda path: None, "found nothing; needed: a video."),
        (lambda path: path.mkdir(), "found a folder; needed: a video."),
        (lambda path: path.write_bytes(b"\x00" * 5000), "cannot be decoded as a video"),
        (lambda path: path.write_text("#EXTM3U\n#EXTINF:1,\n/etc/hostname\n"), "clip.mkv: "),
        (
            lambda path: written(path, places=[0]).write_bytes(path.read_bytes()[:300]),
            "cannot be decoded",
        ),
        (lambda path: written(path, places=[0] * 12), "nothing moves in the 12 frames"),
        (lambda path: written(path, field_step=8, places=range(0, 160, 16)), PLAIN),
        (lambda path: written(path, shape=Fraction(4, 3), places=range(3)), PLAIN),
    ],
)
def test_an_unsupported_video_is_refused(make, said, tmp_path, capsys):
    make(tmp_path / "clip.mkv")
    line = ["frames", str(tmp_path / "clip.mkv"), "-o", str(tmp_path / "photos"), "--count", "5"]
    assert main(line) == 2
    assert said in capsys.readouterr().err.replace("\n", " ")
    assert not (tmp_path / "photos").exists()


def test_a_folder_with_other_files_is_refused(tmp_path, capsys):
    video = written(tmp_path / "clip.mp4", places=range(0, 300, 12))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "a.png").write_bytes(b"mine")
    line = ["frames", str(video), "-o", str(tmp_path / "mine"), "--count", "5", "--overwrite"]
    assert main(line) == 2
    assert (tmp_path / "mine" / "a.png").read_bytes() == b"mine"
    line[3] = str(tmp_path / "photos")
    assert main(line) == main(line) == 0  # frames of a video are replaced
    assert len(list_images(tmp_path / "photos")) == 5
    assert main(line[:-1]) == 2


@pytest.mark.parametrize(
    ("matrix", "wanted"),
    [
        ((1, 0, 0, 1), lambda picture: picture),
        ((0, 1, -1, 0), lambda picture: np.rot90(picture, -1)),
        ((-1, 0, 0, -1), lambda picture: np.rot90(picture, 2)),
        ((0, -1, 1, 0), lambda picture: np.rot90(picture, 1)),
        ((-1, 0, 0, 1), np.fliplr),
        ((1, 0, 0, -1), np.flipud),
        ((0, 1, 1, 0), lambda picture: np.rot90(np.fliplr(picture), 1)),
        ((0, -1, -1, 0), lambda picture: np.rot90(np.fliplr(picture), -1)),
        ((0.1, 0.99, -0.99, 0.1), lambda picture: np.rot90(picture, -1)),
    ],
)
def test_frames_are_rotated_and_mirrored_by_the_display_matrix(matrix, wanted, clip, tmp_path):
    """The matrix of the track's header displays (x, y) at (a x + c y, b x + d y)."""
    turned = tmp_path / "turned.mp4"
    data = bytearray(clip.read_bytes())
    a, b, c, d = (round(65536 * value) for value in matrix)
    place = data.index(b"tkhd") + 4 + 40
    for index, value in enumerate((a, b, 0, c, d)):
        data[place + 4 * index : place + 4 * index + 4] = int(value).to_bytes(4, "big", signed=True)
    turned.write_bytes(data)
    ((_, before),) = frame_pictures(clip, [40])
    ((number, after),) = frame_pictures(turned, [40])
    assert number == 40
    assert np.array_equal(after, wanted(before))


def test_motion_blur_reduces_sharpness_and_light_does_not():
    picture = texture()[:, :WIDTH, 1].astype(np.float32)
    plain = sharpness(torch.from_numpy(picture.astype(np.uint8)))
    dim = sharpness(torch.from_numpy((0.6 * picture).astype(np.uint8)))
    soft = sharpness(torch.from_numpy(gaussian_filter(picture, (0, 2)).astype(np.uint8)))
    assert dim == pytest.approx(plain, rel=0.05)
    assert soft < 0.7 * plain
    assert sharpness(torch.zeros(20, 20, dtype=torch.uint8)) == 0.0


def test_an_object_that_turns_in_front_of_a_wall_is_motion():
    wall, plane = texture(4), texture()
    before, after = (wall[:HEIGHT, :WIDTH, 1].copy() for _ in range(2))
    before[60:200, 100:240], after[60:200, 100:240] = plane[:140, :140, 1], plane[:140, 5:145, 1]
    resting = wall[:HEIGHT, :WIDTH, 1].copy()
    still = motion(*(thumbnail(torch.from_numpy(one)) for one in (resting, resting)))
    moved = motion(*(thumbnail(torch.from_numpy(one)) for one in (before, after)))
    assert still < 0.001
    assert moved == pytest.approx(5 / WIDTH, rel=0.2)


@pytest.mark.parametrize(("curve", "name"), [(16, "PQ"), (18, "HLG")])
def test_high_dynamic_range_gives_a_warning(curve, name, tmp_path):
    video = written(tmp_path / "clip.mp4", curve=curve, places=range(2))
    with pytest.warns(PimperWarning, match=f"clip.mp4: is of high dynamic range, {name}"):
        next(iter(luma_frames(video)))
    plain = written(tmp_path / "plain.mp4", curve=1, places=range(2))
    assert next(iter(luma_frames(plain))).shape == (HEIGHT, WIDTH)
