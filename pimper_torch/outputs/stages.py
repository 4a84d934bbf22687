"""The folder of kept stages inside a folder of results, and the lock in it."""

import errno
import json
import os
import shlex
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from platform import node
from typing import Any

from pimper_torch.errors import OutputError, caution
from pimper_torch.outputs.marker import MARKER, STAGES, mark, read_marker, write_text

LOCK = "lock"
PREVIEW = "preview.png"
"""In the folder of kept stages, while a run is under way: its coarse surface."""

_HOLDER = "holder.json"
# The lock is the last that is removed. Files end in .new while they are written.
_OWN = (_HOLDER, f"{_HOLDER}.new", PREVIEW, f"{PREVIEW}.new", f"{MARKER}.new", MARKER, LOCK)
_TRIES = 5
_MAX_HOLDER = 100_000  # characters: command lines are shorter as a rule
_UNLOCKED = "{}: its disk knows no locks; see that no other run writes there."
_LOCKLESS = (errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP)


def is_ours(stages: Path) -> bool:
    """Return whether a folder of that name was made by us, or is empty."""
    if stages.is_symlink() or not stages.is_dir():
        return False
    marker = read_marker(stages)
    if marker is not None and marker.kind == "stages":
        return True
    return all(path.name in _OWN for path in stages.iterdir())


def kept(target: Path) -> list[Path]:
    """List what is kept for the next run into ``target``."""
    stages = target / STAGES
    if not stages.is_dir() or stages.is_symlink():
        return []
    return sorted(path for path in stages.iterdir() if path.name not in _OWN)


def move_kept(source: Path, target: Path) -> None:
    """Move what is kept for one folder of results to where it is kept for another.

    Raises:
        OSError: It cannot be moved.
    """
    for path in kept(source):
        if not (target / STAGES / path.name).exists():
            path.rename(target / STAGES / path.name)


def remove_stages(target: Path) -> None:
    """Remove the folder of kept stages with all that is in it, if it is ours."""
    stages = target / STAGES
    if is_ours(stages):
        shutil.rmtree(stages, ignore_errors=True)


def link_lock(target: Path, other: Path) -> None:
    """Let ``other`` be locked by who has locked ``target``: both have the same lock.

    Raises:
        OSError: The folder cannot be made.
    """
    (other / STAGES).mkdir()
    with suppress(OSError):  # a disk without hard links
        os.link(target / STAGES / LOCK, other / STAGES / LOCK)


@contextmanager
def locked(target: Path, shown: Path) -> Iterator[None]:
    """Lock a folder of results for this process; a killed process's lock is free.

    Args:
        target: The folder, without links; it is made, not those above it.
        shown: What the user calls it.

    Raises:
        OutputError: Another run holds it.
        OSError: The disk refuses.
    """
    # Local: a refusal of arguments does not need it.
    from filelock import FileLock, Timeout

    stages = target / STAGES
    lock = FileLock(stages / LOCK, timeout=0, thread_local=False)
    for _ in range(_TRIES):
        target.mkdir(exist_ok=True)
        stages.mkdir(exist_ok=True)
        try:
            (stages / LOCK).touch()
            before = (stages / LOCK).stat().st_ino
            lock.acquire()
        except FileNotFoundError:  # whoever held it has just tidied up
            continue
        except NotImplementedError:
            caution(_UNLOCKED.format(shown))
            break
        except (Timeout, RuntimeError) as error:  # a RuntimeError where this thread holds it
            raise OutputError(_told(shown, stages / _HOLDER)) from error
        except OSError as error:
            if error.errno not in _LOCKLESS:
                raise
            caution(_UNLOCKED.format(shown))
            break
        with suppress(OSError):
            if (stages / LOCK).stat().st_ino == before:
                break
        lock.release()
    else:
        raise OutputError(f"{shown}: cannot be locked, as another run comes and goes there.")
    try:
        mark(stages, "stages")
        _write_holder(stages / _HOLDER)
        yield
    finally:
        _tidy(target)
        lock.release()


def _tidy(target: Path) -> None:
    """Remove the folder of kept stages where nothing is kept, and else what told of the run."""
    stages = target / STAGES
    with suppress(OSError):
        for name in (_HOLDER, PREVIEW):
            (stages / name).unlink(missing_ok=True)
        if not kept(target):
            for name in _OWN:
                (stages / name).unlink(missing_ok=True)
            stages.rmdir()


def _write_holder(path: Path) -> None:
    now = datetime.now(UTC).astimezone().isoformat(" ", "seconds")
    command = shlex.join([Path(sys.argv[0] or "python").name, *sys.argv[1:]])
    about = {"process": os.getpid(), "host": node(), "since": now, "command": command}
    write_text(path, json.dumps(about) + "\n")


def _told(shown: Path, path: Path) -> str:
    """Report who holds a folder, as far as it can be read."""
    about: Any = None
    with suppress(OSError, ValueError, RecursionError):
        about = json.loads(path.read_text(encoding="utf-8")[:_MAX_HOLDER])
    if not isinstance(about, dict):
        about = {}
    process, host, since, command = (
        str(about.get(name, "unknown")) for name in ("process", "host", "since", "command")
    )
    return (
        f"{shown}: another run writes there: process {process} on {host} since {since}, "
        f"`{command}`. Wait until it has ended, or write elsewhere."
    )
