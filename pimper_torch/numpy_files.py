"""NumPy's files from strangers: sizes are checked first, pickles are not opened."""

import io
import math
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import IO

import numpy as np

# A choice: depth of 100 million pixels takes as much.
MAX_BYTES = 2**29
_VERSIONS: dict[tuple[int, int], Callable[[IO[bytes]], tuple[tuple[int, ...], bool, np.dtype]]] = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def read_npy(path: Path | str) -> np.ndarray:
    """Read an array of numbers, truth values or texts.

    Raises:
        ValueError: It is none, is larger than its file or than 512 MB, or is cut short: says which.
    """
    path = Path(path)
    size = path.stat().st_size
    with path.open("rb") as file:
        return _array(file, size)


def read_npz(
    path: Path | str, wanted: Callable[[str], bool] = lambda name: True
) -> dict[str, np.ndarray]:
    """Read arrays of an archive that :func:`numpy.savez` wrote, compressed or not.

    Args:
        wanted: Tells the names of arrays to read; others are not looked at.

    Raises:
        ValueError: As :func:`read_npy`, and for what is no such archive.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = {
                entry.filename.removesuffix(".npy"): entry
                for entry in archive.infolist()
                if wanted(entry.filename.removesuffix(".npy"))
            }
            whole = sum(entry.file_size for entry in members.values())
            if whole > MAX_BYTES:
                raise ValueError(f"its arrays would take {whole} bytes, more than {MAX_BYTES}")
            arrays = {}
            for name, entry in members.items():
                with archive.open(entry) as file:
                    arrays[name] = _array(file, entry.file_size)
            return arrays
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        # The last two are of archives that are encrypted, or packed as none of NumPy's are.
        raise ValueError("it is no archive of arrays, or damaged") from error
    except (KeyError, IndexError, OverflowError) as error:
        raise ValueError("its list of contents is damaged") from error


def _array(file: IO[bytes] | zipfile.ZipExtFile, size: int) -> np.ndarray:
    head = file.read(min(size, 2**16 + 12))  # the longest header of version 1
    buffer = io.BytesIO(head)
    try:
        version = np.lib.format.read_magic(buffer)
        shape, columns_first, kind = _VERSIONS[version](buffer)
    except Exception as error:  # a header is a literal of Python, whose parser raises whatever
        raise ValueError("it has no header of an array") from error
    if kind.hasobject:
        raise ValueError("it holds objects of Python, which are not opened")
    if kind.kind not in "biufcSU" or kind.itemsize == 0:
        raise ValueError(f"it holds {kind}, which are no numbers")
    if any(side < 0 for side in shape) or len(shape) > 8:
        raise ValueError(f"it says that its shape is {shape}")
    count = math.prod(shape)
    needed, held = count * kind.itemsize, size - buffer.tell()
    if needed > min(held, MAX_BYTES):
        raise ValueError(f"it says that it holds {needed} bytes; there are {held}")
    values = bytearray(head[buffer.tell() :][:needed])  # may be written to, as torch wants it
    values += file.read(needed - len(values))
    if len(values) < needed:
        raise ValueError(f"it ends after {len(values)} of {needed} bytes")
    array = np.frombuffer(values, kind, count)
    if columns_first:
        return array.reshape(shape[::-1]).T
    return array.reshape(shape)
