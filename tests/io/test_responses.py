import numpy as np
import pytest
import torch
from torch.testing import assert_close

from pimper_torch.io.responses import read_curve, response_of
from pimper_torch.radiometry import Encoding, Gamma, Linear, Srgb
from pimper_torch.runtime.errors import InputError

LEVELS = np.arange(256.0)
CURVE = 7 * (LEVELS / 255) ** 1.8
COLOURS = np.stack([CURVE, LEVELS, LEVELS**2 + LEVELS], axis=1)


def write(path, table):
    if path.suffix == ".npy":
        np.save(path, table)
    else:
        np.savetxt(path, table, delimiter=",")
    return path


@pytest.mark.parametrize(
    ("suffix", "radiance", "leveled"),
    [
        ("csv", CURVE[:, None], False),
        ("csv", COLOURS, True),
        ("npy", COLOURS, False),
        ("npy", CURVE[:, None], True),
    ],
)
def test_a_table_with_and_without_levels_is_read(tmp_path, suffix, radiance, leveled):
    table = np.concatenate([LEVELS[:, None], radiance], axis=1) if leveled else radiance
    curve = read_curve(write(tmp_path / f"a.{suffix}", table))
    assert curve.bits == 8
    assert_close(curve.encoded, torch.from_numpy(LEVELS / 255))
    assert_close(curve.radiance, torch.from_numpy((radiance / radiance[-1]).T.copy()))


def test_column_names_semicolons_and_fractions_are_read(tmp_path):
    rows = [f"{level / 255};{value}" for level, value in zip(LEVELS, CURVE, strict=True)]
    (tmp_path / "a.csv").write_text("level;radiance\n" + "\n".join(rows) + "\n\n")
    curve = read_curve(tmp_path / "a.csv")
    assert curve.bits is None
    assert_close(curve.radiance[0], torch.from_numpy(CURVE / 7))


def test_responses_calibrated_by_opencv_are_read(tmp_path):
    np.save(tmp_path / "a.npy", COLOURS[:, None].astype(np.float32))
    curve = read_curve(tmp_path / "a.npy")
    wanted = torch.from_numpy((COLOURS / COLOURS[-1]).T.copy())
    assert_close(curve.radiance, wanted, rtol=1e-6, atol=1e-7)  # float32 in the file


def test_every_choice_gives_its_response(tmp_path):
    path = write(tmp_path / "a.npy", CURVE[:, None])
    assert response_of(Encoding()) == Srgb()
    assert response_of(Encoding(response="linear")) == Linear()
    assert response_of(Encoding(response=1.8)) == Gamma(exponent=1.8)
    assert response_of(Encoding(response=path)).bits == 8


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", "1,2\n3\n", r"a\.csv: has no table .*different lengths"),
        ("a.csv", "", "no rows, or rows of different lengths"),
        ("a.csv", "0,1\n1,dark\n", "has no table"),
        ("a.csv", "\n".join("1,2,3,4,5" for _ in range(20)), "a table of 20 x 5"),
        ("a.csv", "\n".join(map(str, range(100))), "is not a response curve: the last"),
        ("a.npy", "not an array", "has no table"),
        ("a.xlsx", "", r"a\.xlsx: is not a response .*needed: srgb, linear"),
    ],
)
def test_files_without_a_curve_are_refused_by_name(tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=message):
        read_curve(tmp_path / name)


def test_a_misspelt_choice_and_a_missing_or_huge_file_are_refused(tmp_path):
    for name in ("sRGB", "curve.csv"):
        with pytest.raises(InputError, match=f"{name}: is not a response .*needed: srgb, linear"):
            response_of(Encoding(response=tmp_path / name))
    with (tmp_path / "a.csv").open("wb") as file:
        file.truncate(30_000_000)
    with pytest.raises(InputError, match="30000000 bytes; needed: a small table"):
        read_curve(tmp_path / "a.csv")


def test_pickled_objects_are_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.array([{"radiance": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="has no table"):
        read_curve(tmp_path / "a.npy")
