"""Safe reading of NumPy files: sizes are checked first, pickles are not opened."""

import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

# Chosen for depth maps of up to 100 million pixels.
MAX_BYTES = 2**29


def read_npy(path: Path | str) -> np.ndarray:
    """Return an array of numbers, booleans or texts from a NPY file.

    Raises:
        ValueError: It is not such an array, is larger than 512 MB, or does not match its file.
    """
    _require_small(Path(path).stat().st_size)
    try:
        # When NumPy maps a file, it compares the size with that in the header.
        return np.array(_plain(np.lib.format.open_memmap(path, mode="r")))
    except Exception as error:  # the header is a Python literal; its parser raises any error
        raise ValueError(f"it is not a NumPy array ({error})") from error


def read_npz(
    path: Path | str, wanted: Callable[[str], bool] = lambda name: True
) -> dict[str, np.ndarray]:
    """Return arrays of an archive written by :func:`numpy.savez`, compressed or not, by name.

    Args:
        wanted: Returns whether to read the array of a name.

    Raises:
        ValueError: The file is not such an archive, or as for :func:`read_npy`.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            sizes = {e.filename.removesuffix(".npy"): e.file_size for e in archive.infolist()}
            _require_small(sum(size for name, size in sizes.items() if wanted(name)))
        with np.load(path, allow_pickle=False) as arrays:
            return {name: _plain(arrays[name]) for name in arrays.files if wanted(name)}
    except Exception as error:
        raise ValueError(f"it is not a NumPy archive ({error})") from error


def _require_small(size: int) -> None:
    if size > MAX_BYTES:
        raise ValueError(f"its arrays would take {size} bytes, more than {MAX_BYTES}")


def _plain(array: np.ndarray) -> np.ndarray:
    if array.dtype.kind not in "biufcSU" or array.itemsize == 0:
        raise ValueError(f"it contains {array.dtype} instead of numbers")
    return array
