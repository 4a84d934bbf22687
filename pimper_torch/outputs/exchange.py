"""Two folders change their names, so that no moment sees neither."""

import ctypes
import errno
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # Linux: fcntl.h, linux/fs.h
_RENAME_SWAP = 2  # macOS: sys/stdio.h
_UNSUPPORTED = (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP)


def exchange(one: Path, other: Path, spare: Path) -> None:
    """Assign ``one`` the name of ``other`` and the other way round.

    At once, by `renameat2` of Linux or `renamex_np` of macOS; where system or disk have no such
    call, by three renames, with ``one`` under the name ``spare`` in between.

    Raises:
        OSError: They cannot be renamed, as mount points cannot; they are as before then.
    """
    try:
        _at_once(one, other)
    except OSError as error:
        if error.errno not in _UNSUPPORTED:
            raise
        _one_by_one(one, other, spare)


def _at_once(one: Path, other: Path) -> None:
    call = _call()
    if call is None:
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
    if call(os.fsencode(one), os.fsencode(other)) != 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code), str(one), None, str(other))


def _call() -> Callable[[bytes, bytes], int] | None:
    if sys.platform not in ("linux", "darwin"):
        return None
    library = ctypes.CDLL(None, use_errno=True)
    try:
        if sys.platform == "darwin":
            swap = library.renamex_np
            return lambda one, other: int(swap(one, other, _RENAME_SWAP))
        rename = library.renameat2
        return lambda one, other: int(rename(_AT_FDCWD, one, _AT_FDCWD, other, _RENAME_EXCHANGE))
    except AttributeError:  # a C library before 2018
        return None


def _one_by_one(one: Path, other: Path, spare: Path) -> None:
    one.rename(spare)
    try:
        other.rename(one)
    except BaseException:
        spare.rename(one)
        raise
    with suppress(OSError):  # then it stays there
        spare.rename(other)
