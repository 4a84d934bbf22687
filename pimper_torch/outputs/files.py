"""Single files of results: whole or not at all, and in the place of our own alone."""

import json
import os
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from pimper_torch.errors import OutputError
from pimper_torch.outputs.names import require_name

_PNG = b"\x89PNG\r\n\x1a\n"
_HEAD = 4096  # bytes: what a PNG says of itself stands before its pixels
_MAX_BYTES = 1 << 26


def prepare_file(path: Path, overwrite: bool, is_ours: Callable[[Path], bool]) -> None:
    """Refuse, before the work, a file that cannot be written or is not ours.

    Args:
        overwrite: Replace a former one.
        is_ours: Whether a file is one that we wrote.

    Raises:
        OutputError: Something is there, or the path lies in no folder.
    """
    require_name(path.resolve(), OutputError)
    if path.is_dir():
        raise OutputError(f"{path}: is a folder; needed: the name of a file.")
    if not path.resolve().parent.is_dir():
        raise OutputError(f"{path}: its folder is not there. Make it, or write elsewhere.")
    if not os.path.lexists(path.resolve()):
        return
    if not path.is_file():
        raise OutputError(f"{path}: is no ordinary file. Write elsewhere.")
    if not overwrite:
        raise OutputError(f"{path}: is there already. Write elsewhere, or add `--overwrite`.")
    if not is_ours(path):
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


def says_of_itself(path: Path, key: str, value: str) -> bool:
    """Return whether a file is a JSON object that has a value under a key."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            return False
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(content, dict) and content.get(key) == value


def is_titled(path: Path, title: str) -> bool:
    """Return whether a file is a PNG of a title."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
    except OSError:
        return False
    return head.startswith(_PNG) and b"tEXtTitle\0" + title.encode() in head
