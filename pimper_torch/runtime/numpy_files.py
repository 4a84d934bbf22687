"""NumPy's files from strangers: sizes are checked first, pickles are not opened."""

import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

# A choice: depth of 100 million pixels takes as much.
MAX_BYTES = 2**29


def read_npy(path: Path | str) -> np.ndarray:
    """Read an array of numbers, truth values or texts.

    Raises:
        ValueError: It is none, is larger than its file or than 512 MB, or is cut short.
    """
    _require_small(Path(path).stat().st_size)
    try:
        # Where a file is mapped, NumPy compares its size with what its header says.
        return np.array(_plain(np.lib.format.open_memmap(path, mode="r")))
    except Exception as error:  # a header is a literal of Python, whose parser raises whatever
        raise ValueError(f"it is no array of NumPy ({error})") from error


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
            _require_small(sum(one.file_size for name, one in entries.items() if wanted(name)))
        with np.load(path, allow_pickle=False) as arrays:
            return {name: _plain(arrays[name]) for name in arrays.files if wanted(name)}
    except Exception as error:
        raise ValueError(f"it is no archive of arrays ({error})") from error


def _require_small(size: int) -> None:
    if size > MAX_BYTES:
        raise ValueError(f"its arrays would take {size} bytes, more than {MAX_BYTES}")


def _plain(array: np.ndarray) -> np.ndarray:
    if array.dtype.kind not in "biufcSU" or array.itemsize == 0:
        raise ValueError(f"it holds {array.dtype}, which are no numbers")
    return array
