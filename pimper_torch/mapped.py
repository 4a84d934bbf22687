"""Tensors in files, so that photographs that are larger than memory are as others to every stage.

A page is read when it is used, and the system writes and drops it when it needs the memory. The
files have no names, so that nothing is left of them when the process ends, however it does.
"""

import mmap
import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from math import prod
from pathlib import Path
from weakref import WeakSet

import torch
from torch import Tensor

from pimper_torch.errors import OutputError

# Bytes from which a tensor is in a file: a choice. Photographs of smaller sets stay in memory.
LARGE = 2**28

_mapped: WeakSet[mmap.mmap] = WeakSet()


def zeros(
    shape: Sequence[int],
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Tensor:
    """Return zeros, in a file where they are large and on the CPU.

    The file is in the folder for temporary files (``TMPDIR``), or in ``/var/tmp`` where that one is
    itself in memory. Its space is reserved at once.

    Raises:
        OutputError: The disk has too little space.
    """
    size = prod(shape) * dtype.itemsize
    folder = _folder() if size >= LARGE and torch.device(device).type == "cpu" else None
    if folder is None:
        return torch.zeros(*shape, dtype=dtype, device=device)
    try:
        with tempfile.TemporaryFile(prefix="pimper_", dir=folder) as file:
            # Writing to pages for which there is no space would kill the process.
            getattr(os, "posix_fallocate", lambda *_: file.truncate(size))(file.fileno(), 0, size)
            pages = mmap.mmap(file.fileno(), size)
    except OSError as error:
        raise OutputError(
            f"{folder}: has no space for {size / 1e9:.1f} GB of photographs ({error.strerror}); "
            "photographs that are large together are kept on disk. Free space, set TMPDIR to a "
            "folder of another disk, or shrink the photographs (`--max-size-px`)."
        ) from error
    _mapped.add(pages)
    return torch.frombuffer(pages, dtype=dtype).view(*shape)


def drop_pages() -> None:
    """Let go of the pages of all files; what was written to them stays."""
    if hasattr(mmap, "MADV_DONTNEED"):
        for pages in list(_mapped):
            pages.madvise(mmap.MADV_DONTNEED)


def each(*rasters: Sequence[Tensor] | Tensor) -> Iterator[tuple[Tensor, ...]]:
    """Go through the views of rasters together, and drop the pages of each behind it."""
    for views in zip(*rasters, strict=True):
        yield views
        drop_pages()


def _folder() -> str | None:
    """Return the first folder for temporary files that is on a disk."""
    folders = (tempfile.gettempdir(), "/var/tmp")
    return next((one for one in folders if os.access(one, os.W_OK) and not _in_memory(one)), None)


def _in_memory(folder: str) -> bool:
    """Return whether files of a folder take memory; false where the system does not tell."""
    with suppress(OSError):
        lines = Path("/proc/mounts").read_text(encoding="utf-8").splitlines()
        kinds = {line.split()[1]: line.split()[2] for line in lines}
        place = Path(folder).resolve()
        points = [str(one) for one in (place, *place.parents) if str(one) in kinds]
        return bool(points) and kinds[points[0]] in ("tmpfs", "ramfs")
    return False
