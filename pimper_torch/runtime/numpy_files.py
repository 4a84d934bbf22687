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
    _require_small(Path(path).stat().st_size)
    return _array(Path(path).read_bytes())


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
            entries = {one.filename.removesuffix(".npy"): one for one in archive.infolist()}
            entries = {name: one for name, one in entries.items() if wanted(name)}
            _require_small(sum(one.file_size for one in entries.values()))
            return {name: _array(archive.read(one)) for name, one in entries.items()}
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        # The last two are of archives that are encrypted, or packed as none of NumPy's are.
        raise ValueError("it is no archive of arrays, or damaged") from error
    except (KeyError, IndexError, OverflowError) as error:
        raise ValueError("its list of contents is damaged") from error


def _require_small(size: int) -> None:
    if size > MAX_BYTES:
        raise ValueError(f"its arrays would take {size} bytes, more than {MAX_BYTES}")


def _array(data: bytes) -> np.ndarray:
    buffer = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(buffer)
        shape, columns_first, kind = _VERSIONS[version](buffer)
    except Exception as error:  # a header is a literal of Python, whose parser raises whatever
        raise ValueError("it has no header of an array") from error
    if kind.kind not in "biufcSU" or kind.itemsize == 0:  # objects are not opened
        raise ValueError(f"it holds {kind}, which are no numbers")
    if any(side < 0 for side in shape) or len(shape) > 8:
        raise ValueError(f"it says that its shape is {shape}")
    needed, at = math.prod(shape) * kind.itemsize, buffer.tell()
    if needed > len(data) - at:
        raise ValueError(f"it says that it holds {needed} bytes; there are {len(data) - at}")
    values = bytearray(data[at : at + needed])  # may be written to, as torch wants it
    return np.frombuffer(values, kind).reshape(shape, order="F" if columns_first else "C")
