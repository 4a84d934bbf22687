"""The folder of kept stages inside a folder of results, and the lock in it."""

import os
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from platform import node

from pimper_torch.doors.result_folder.marker import MARKER, STAGES
from pimper_torch.runtime.errors import OutputError

LOCK, NEW, HOLDER = "lock", "new", "holder.txt"
"""Names in the folder of kept stages: its lock, a result that is being written, who holds it."""
PREVIEW = "preview.png"
"""In the folder of kept stages, while a run is under way: its coarse surface."""

_PASSING = (HOLDER, PREVIEW, f"{PREVIEW}.new")


def is_ours(stages: Path) -> bool:
    """Return whether a folder of that name was made by us, or is empty."""
    if stages.is_symlink() or not stages.is_dir():
        return False
    names = {path.name for path in stages.iterdir()}
    return not names or bool(names & {LOCK, HOLDER})


def kept(target: Path) -> list[Path]:
    """List what is kept for the next run into ``target``."""
    stages, own = target / STAGES, (LOCK, MARKER, NEW, *_PASSING)
    there = sorted(stages.iterdir()) if stages.is_dir() else []
    return [path for path in there if path.name not in own]


def resumption(shown: Path) -> str:
    """Return a sentence on how the next run goes on from what is kept."""
    return (
        f"What was finished is kept in {shown / STAGES}: the same command goes on from there, and "
        f"`pimper clean {shown}` removes it."
    )


@contextmanager
def locked(target: Path, shown: Path) -> Iterator[None]:
    """Lock a folder of results for this process; a killed process's lock is free.

    Args:
        target: The folder, without links. It is made, and its parents are.
    """
    # Local: a refusal of arguments does not need it.
    from filelock import FileLock, Timeout

    stages = target / STAGES
    holder = stages / HOLDER
    lock = FileLock(stages / LOCK, timeout=0, thread_local=False)
    try:
        stages.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except NotImplementedError as error:
        raise OutputError(f"{shown}: its disk knows no locks. Write elsewhere.") from error
    except (Timeout, RuntimeError) as error:  # a RuntimeError where this thread holds it
        known = "of which nothing is known"
        with suppress(OSError):
            known = holder.read_text(encoding="utf-8")
        raise OutputError(
            f"{shown}: another run writes there: {known}. Wait until it has ended, end it where "
            "it hangs, or write elsewhere."
        ) from error
    except OSError as error:
        raise OutputError(f"{shown}: cannot be locked ({error}). Write elsewhere.") from error
    try:
        with suppress(OSError):  # the disk is full
            command = shlex.join([Path(sys.argv[0] or "python").name, *sys.argv[1:]])
            now = datetime.now().astimezone().isoformat(" ", "minutes")
            told = f"process {os.getpid()} on {node()} since {now}, `{command}`"
            holder.write_text(told, encoding="utf-8")
        yield
    finally:
        with suppress(OSError):
            for name in _PASSING:
                (stages / name).unlink(missing_ok=True)
            if [path.name for path in stages.iterdir()] == [LOCK]:  # nothing is kept
                (stages / LOCK).unlink()
                stages.rmdir()
        lock.release()
