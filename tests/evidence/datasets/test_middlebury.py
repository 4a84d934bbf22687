import pytest

from pimper_torch.errors import InputError
from pimper_torch.evidence.datasets.middlebury import read_middlebury

# The camera `hand_camera`; K with a skew of 5, principal point (7, 5) counted from a corner.
LINE = "20 5 6.5 0 30 4.5 0 0 1  0 1 0 0 0 1 1 0 0  -2 -3 4"


@pytest.fixture
def folder(tmp_path, paint):
    for name in ("t1.png", "t2.png"):
        paint(tmp_path / name, 100)
    (tmp_path / "toy_par.txt").write_text(f"2\nt1.png {LINE}\nt2.png {LINE}\n")
    return tmp_path


def test_the_camera_is_k_r_t_and_centres_count_from_0(folder, sees):
    capture = read_middlebury(folder)
    # u = 7 + 20 * 0.1 + 5 * 0.2, v = 5 + 30 * 0.2.
    assert sees(capture) == pytest.approx([10, 11])
    assert capture.views.names == ("t1.png", "t2.png")
    assert capture.light.tolist() == [0, 0]
    assert capture.position.tolist() == [0, 1]


def test_the_file_itself_may_be_named(folder, sees):
    (folder / "other_par.txt").touch()
    assert sees(read_middlebury(folder / "toy_par.txt")) == pytest.approx([10, 11])
    with pytest.raises(InputError, match=r"one file named \*_par\.txt"):
        read_middlebury(folder)


@pytest.mark.parametrize(
    ("text", "needed"),
    [
        ("", "the number of photographs"),
        ("3\nt1.png " + LINE, "the number of photographs"),
        ("t1.png " + LINE, "the number of photographs"),
        ("1\nt1.png " + LINE + " 7", "21 finite numbers"),
        ("1\nt1.png " + LINE.replace("20", "x"), "21 finite numbers"),
        ("1\nt1.png " + LINE.replace("0 0 1  0", "0 0 2  0"), "K33 = 1"),
        ("1\nt1.png " + LINE.replace("20 5", "-20 5"), "positive focal lengths"),
        ("1\nt1.png " + LINE.replace("  0 1 0", "  0 -1 0"), "a reflection"),
        ("1\nt3.png " + LINE, r"the photograph t3\.png"),
        ("1\n../t1.png " + LINE, "leads out of it"),
    ],
)
def test_another_file_is_refused(folder, text, needed):
    (folder / "toy_par.txt").write_text(text)
    with pytest.raises(InputError, match=needed):
        read_middlebury(folder)
