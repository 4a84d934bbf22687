"""Memory-mapped tensors, so that stages can process photographs larger than memory.

The system reads pages on use, and writes and drops them when it needs the memory. The files have no
names, so they disappear when the process ends in any way.
"""

import mmap
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from itertools import chain
from math import prod
from pathlib import Path
from threading import Lock
from weakref import WeakSet

import torch
from torch import Tensor

from pimper_torch.runtime.errors import OutputError

# Minimum bytes of a tensor in a file, chosen by hand. Photographs of smaller sets stay in memory.
LARGE = 2**26

_mapped: WeakSet[mmap.mmap] = WeakSet()
_lock = Lock()  # of the set, which must not change during iteration


def zeros(
    shape: Sequence[int], dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> Tensor:
    """Return zeros, in a file if they are large and on the CPU.

    The file is in the folder for temporary files (``TMPDIR``), or in ``/var/tmp`` if that folder is
    itself in memory. Its disk space is reserved immediately.

    Raises:
        OutputError: The disk has too little space.
    """
    size = prod(shape) * dtype.itemsize
    folder = _folder() if size >= LARGE and torch.device(device).type == "cpu" else None
    if folder is None:
        return torch.zeros(list(shape), dtype=dtype, device=device)
    try:
        with tempfile.TemporaryFile(prefix="pimper_", dir=folder) as file:
            # Writing to pages without disk space would kill the process.
            getattr(os, "posix_fallocate", lambda *_: file.truncate(size))(file.fileno(), 0, size)
            pages = mmap.mmap(file.fileno(), size)
    except OSError as error:
        raise OutputError(
            f"{folder}: has no space for {size / 1e9:.1f} GB of photographs ({error.strerror}); "
            "large sets of photographs are kept on disk. Free space, set TMPDIR to a folder on "
            "another disk, or shrink the photographs (`--max-size-px`)."
        ) from error
    with _lock:
        _mapped.add(pages)
    return torch.frombuffer(pages, dtype=dtype).view(list(shape))


def copied(tensor: Tensor) -> Tensor:
    """Return a contiguous copy of a tensor, in a file if it is large. Differentiable."""
    return zeros(tensor.shape, tensor.dtype, tensor.device).copy_(tensor)


def take_rows(tensor: Tensor, index: slice | Tensor) -> Tensor:
    """Return rows of the first axis, in a file if the result is large."""
    if isinstance(index, slice) or tensor.nbytes < LARGE or tensor.requires_grad:
        return tensor[index]
    rows = torch.arange(len(tensor), device=tensor.device)[index]
    result = zeros((len(rows), *tensor.shape[1:]), tensor.dtype, tensor.device)
    size = max(1, len(tensor) * LARGE // tensor.nbytes)
    for chunk, indices in zip(torch.split(result, size), torch.split(rows, size), strict=True):
        chunk.copy_(tensor[indices])
        drop_pages()
    return result


def parts(shapes: Sequence[Sequence[int]], device: torch.device | str = "cpu") -> list[Tensor]:
    """Return zeros of several shapes, in one file if they are large together."""
    sizes = list(map(prod, shapes))
    pieces = torch.split(zeros((sum(sizes),), device=device), sizes)
    return [piece.view(*shape) for piece, shape in zip(pieces, shapes, strict=True)]


def by_view(work: Callable[..., Tensor], *rasters: Sequence[Tensor] | Tensor) -> Tensor:
    """Return the stacked results of a function that is called for each view.

    Args:
        work: Receives the view's entry of every raster; returns tensors of one shape.
        rasters: Rasters of at least one view.
    """
    return stacked((work(*views) for views in each(*rasters)), len(rasters[0]))


def stacked(tensors: Iterator[Tensor], count: int) -> Tensor:
    """Stack ``count`` tensors of one shape as they arrive, in a file if they are large together."""
    first = next(tensors)
    result = zeros((count, *first.shape), first.dtype, first.device)
    for index, tensor in enumerate(chain([first], tensors)):
        result[index] = tensor
    return result


def drop_pages() -> None:
    """Release the pages of all files from memory; their data stays in the files."""
    if hasattr(mmap, "MADV_DONTNEED"):
        with _lock:
            mapped = list(_mapped)
        for pages in mapped:
            pages.madvise(mmap.MADV_DONTNEED)


def each(*rasters: Sequence[Tensor] | Tensor) -> Iterator[tuple[Tensor, ...]]:
    """Iterate over the views of several rasters, and drop the pages of each view afterwards."""
    for views in zip(*rasters, strict=True):
        yield views
        drop_pages()


def _folder() -> str | None:
    """Return the first writable folder for temporary files that is on a disk."""
    folders = (tempfile.gettempdir(), "/var/tmp")
    on_disk = (path for path in folders if os.access(path, os.W_OK) and not _in_memory(path))
    return next(on_disk, None)


def _in_memory(folder: str) -> bool:
    """Return whether a folder is in memory; false if the system does not report it."""
    with suppress(OSError):
        lines = Path("/proc/mounts").read_text(encoding="utf-8").splitlines()
        kinds = {line.split()[1]: line.split()[2] for line in lines}
        path = Path(folder).resolve()
        mounts = [str(parent) for parent in (path, *path.parents) if str(parent) in kinds]
        return bool(mounts) and kinds[mounts[0]] in ("tmpfs", "ramfs")
    return False
