"""Single files of results: whole or not at all, and in the place of our own alone."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from os import fspath
from pathlib import Path

from pimper_torch.runtime.errors import OutputError, PimperError


def prepare_file(path: Path, overwrite: bool, sign: str) -> None:
    """Refuse, before the work, a file that cannot be written or is not ours.

    Args:
        sign: Text that every file of this kind holds.
    """
    require_name(path.resolve(), OutputError)
    if not path.resolve().parent.is_dir():
        raise OutputError(f"{path}: its folder is not there. Make it, or write elsewhere.")
    if not path.exists():
        return
    if not path.is_file():
        raise OutputError(f"{path}: is no ordinary file. Write elsewhere.")
    if not overwrite:
        raise OutputError(f"{path}: is there already. Write elsewhere, or add `--overwrite`.")
    if sign.encode() not in path.read_bytes():
        raise OutputError(
            f"{path}: was not written by this command, so it is not overwritten. Write elsewhere."
        )


@contextmanager
def file_written_whole(path: Path) -> Iterator[Path]:
    """Return the name of a file to write, which takes the place of ``path`` when all went well.

    Raises:
        OutputError: The disk refuses; then what was there is there still.
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
    """Refuse, before any work, a name that libraries and files of text cannot hold.

    Args:
        error: What is raised where it is not UTF-8.
    """
    shown = fspath(name).encode("utf-8", "backslashreplace").decode()
    if shown != fspath(name):
        raise error(f"{shown}: the name is not UTF-8; needed: one that is. Rename it.")
