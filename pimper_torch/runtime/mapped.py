"""Tensors in files, so that photographs that are larger than memory are as others to every stage.

A page is read when it is used, and the system writes and drops it when it needs the memory. The
files have no names, so that nothing is left of them when the process ends, however it does.
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

# Bytes from which a tensor is in a file: a choice. Photographs of smaller sets stay in memory.
LARGE = 2**26

_mapped: WeakSet[mmap.mmap] = WeakSet()
_lock = Lock()  # of the set, which no thread may add to while another goes through it


def zeros(
    shape: Sequence[int], dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
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
        return torch.zeros(list(shape), dtype=dtype, device=device)
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
    with _lock:
        _mapped.add(pages)
    return torch.frombuffer(pages, dtype=dtype).view(list(shape))


def copied(tensor: Tensor) -> Tensor:
    """Copy a tensor to contiguous memory, or a file where it is large. Differentiable."""
    return zeros(tensor.shape, tensor.dtype, tensor.device).copy_(tensor)


def take_rows(tensor: Tensor, index: slice | Tensor) -> Tensor:
    """Index the first axis, into a file where the result is large."""
    if isinstance(index, slice) or tensor.nbytes < LARGE or tensor.requires_grad:
        return tensor[index]
    rows = torch.arange(len(tensor), device=tensor.device)[index]
    found = zeros((len(rows), *tensor.shape[1:]), tensor.dtype, tensor.device)
    at_once = max(1, len(tensor) * LARGE // tensor.nbytes)
    for into, some in zip(torch.split(found, at_once), torch.split(rows, at_once), strict=True):
        into.copy_(tensor[some])
        drop_pages()
    return found


def parts(shapes: Sequence[Sequence[int]], device: torch.device | str = "cpu") -> list[Tensor]:
    """Return zeros of several shapes, together in a file where they are large together."""
    sizes = list(map(prod, shapes))
    pieces = torch.split(zeros((sum(sizes),), device=device), sizes)
    return [piece.view(*shape) for piece, shape in zip(pieces, shapes, strict=True)]


def by_view(work: Callable[..., Tensor], *rasters: Sequence[Tensor] | Tensor) -> Tensor:
    """Stack what is computed of every view by itself.

    Args:
        work: Called with the view of every raster; gives tensors of one shape.
        rasters: Of at least one view.
    """
    return stacked((work(*some) for some in each(*rasters)), len(rasters[0]))


def stacked(tensors: Iterator[Tensor], count: int) -> Tensor:
    """Stack tensors of one shape as they come, in a file where they are large together."""
    first = next(tensors)
    found = zeros((count, *first.shape), first.dtype, first.device)
    for place, one in enumerate(chain([first], tensors)):
        found[place] = one
    return found


def drop_pages() -> None:
    """Let go of the pages of all files; what was written to them stays."""
    if hasattr(mmap, "MADV_DONTNEED"):
        with _lock:
            mapped = list(_mapped)
        for pages in mapped:
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
    """Return whether files of a folder take memory; false where the system does not say."""
    with suppress(OSError):
        lines = Path("/proc/mounts").read_text(encoding="utf-8").splitlines()
        kinds = {line.split()[1]: line.split()[2] for line in lines}
        place = Path(folder).resolve()
        points = [str(one) for one in (place, *place.parents) if str(one) in kinds]
        return bool(points) and kinds[points[0]] in ("tmpfs", "ramfs")
    return False
