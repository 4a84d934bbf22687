"""Output files: written completely or not at all, and replacing only files of this package."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from os import fspath
from pathlib import Path

from pimper_torch.runtime.errors import OutputError, PimperError


def prepare_file(path: Path, overwrite: bool, sign: str) -> None:
    """Check, before any work, that a file can be written, and is of this kind if it exists.

    Args:
        sign: Text that every file of this kind contains.
    """
    require_name(path.resolve(), OutputError)
    if not path.resolve().parent.is_dir():
        raise OutputError(f"{path}: its folder does not exist. Create it, or write elsewhere.")
    if not path.exists():
        return
    if not path.is_file():
        raise OutputError(f"{path}: is not a regular file. Write elsewhere.")
    if not overwrite:
        raise OutputError(f"{path}: already exists. Write elsewhere, or add `--overwrite`.")
    if sign.encode() not in path.read_bytes():
        raise OutputError(
            f"{path}: was not written by this command, so it is not overwritten. Write elsewhere."
        )


@contextmanager
def file_written_whole(path: Path) -> Iterator[Path]:
    """Yield the path of a temporary file, which replaces ``path`` if the block succeeds.

    Raises:
        OutputError: Writing failed; ``path`` is then unchanged.
    """
    target = path.resolve()
    fresh = target.with_name(f".pimper-{secrets.token_hex(4)}.new")
    try:
        yield fresh
        with fresh.open("rb+") as file:
            os.fsync(file.fileno())
        fresh.replace(target)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error}).") from error
    finally:
        fresh.unlink(missing_ok=True)


def require_name(name: Path | str, error: type[PimperError]) -> None:
    """Raise ``error`` for a name that is not UTF-8: libraries and text files cannot contain it."""
    printable = fspath(name).encode("utf-8", "backslashreplace").decode()
    if printable != fspath(name):
        raise error(f"{printable}: the name is not UTF-8; needed: a name in UTF-8. Rename it.")
