"""Files written by NumPy are read, and untrusted ones allocate no memory."""

import io
import struct
import zipfile
from resource import RUSAGE_SELF, getrusage

import numpy as np
import pytest

from pimper_torch.runtime.numpy_files import read_npy, read_npz


@pytest.mark.parametrize(
    "array",
    [
        np.arange(12.0).reshape(3, 4),
        np.asfortranarray(np.arange(24, dtype=np.int16).reshape(2, 3, 4)),
        np.zeros((0, 3), dtype=np.float32),
        np.array("name"),
        np.array([True, False]),
        np.arange(3, dtype=">f4"),
    ],
)
def test_arrays_are_read_as_by_numpy(array, tmp_path):
    np.save(tmp_path / "a.npy", array)
    np.savez_compressed(tmp_path / "a.npz", first=array, second=array[..., None])
    np.testing.assert_array_equal(read_npy(tmp_path / "a.npy"), array)
    read = read_npz(tmp_path / "a.npz", lambda name: name == "first")
    assert list(read) == ["first"]
    np.testing.assert_array_equal(read["first"], array)
    assert read["first"].dtype == array.dtype


def header(text):
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


@pytest.mark.parametrize(
    "text",
    [
        "{'descr': '<f8', 'fortran_order': False, 'shape': (2000000000,), }\n",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-1, 3), }\n",
        "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }\n",
        "{'descr': '|V0', 'fortran_order': False, 'shape': (10000000000,), }\n",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (",
        "(" * 9000,
        "{'descr': '<f8', 'fortran_order': False, 'shape': (2**9**9,), }\n",
    ],
)
def test_an_oversized_header_is_refused_before_allocation(tmp_path, text):
    (tmp_path / "a.npy").write_bytes(header(text) + bytes(64))
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", header(text) + bytes(64))
    before = getrusage(RUSAGE_SELF).ru_maxrss
    for read in (read_npy, read_npz):
        with pytest.raises(ValueError, match="it is not a NumPy ar"):
            read(tmp_path / ("a.npy" if read is read_npy else "a.npz"))
    assert getrusage(RUSAGE_SELF).ru_maxrss - before < 1e4  # kB


def test_an_archive_that_unpacks_beyond_the_limit_is_refused(tmp_path):
    with (
        zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("a.npy", "w") as member,
    ):
        for _ in range(33):
            member.write(bytes(2**24))
    assert (tmp_path / "a.npz").stat().st_size < 10_000_000
    with pytest.raises(ValueError, match="would take 553648128 bytes"):
        read_npz(tmp_path / "a.npz")


def test_a_file_without_array_or_archive_is_refused(tmp_path):
    path = tmp_path / "a"
    whole = io.BytesIO()
    np.savez_compressed(whole, a=np.random.default_rng(0).random(100))
    damaged = bytearray(whole.getvalue())
    damaged[len(damaged) // 3 : len(damaged) // 2] = bytes(len(damaged) // 2 - len(damaged) // 3)
    for content in (b"", b"PK", b"text", bytes(damaged), whole.getvalue()[:200]):
        path.write_bytes(content)
        for read in (read_npy, read_npz):
            with pytest.raises(ValueError, match="it "):
                read(path)
