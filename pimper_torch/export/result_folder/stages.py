"""Folder of kept stages inside a result folder, and its lock."""

import os
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from platform import node

from pimper_torch.export.result_folder.marker import MARKER, STAGES
from pimper_torch.runtime.errors import OutputError

LOCK, NEW, HOLDER = "lock", "new", "holder.txt"
"""Names in the folder of kept stages: its lock, the result being written, owner of the lock."""
PREVIEW = "preview.png"
"""Image of what is found so far in the folder of kept stages, during a run."""

_PASSING = (HOLDER, PREVIEW, f"{PREVIEW}.new")


def is_ours(stages: Path) -> bool:
    """Return whether a folder of kept stages was created by this package, or is empty."""
    if stages.is_symlink() or not stages.is_dir():
        return False
    names = {path.name for path in stages.iterdir()}
    return not names or bool(names & {LOCK, HOLDER})


def kept_stages(target: Path) -> list[Path]:
    """List the stages that are kept for the next run into ``target``."""
    stages, internal = target / STAGES, (LOCK, MARKER, NEW, *_PASSING)
    entries = sorted(stages.iterdir()) if stages.is_dir() else []
    return [path for path in entries if path.name not in internal]


def resumption(folder: Path) -> str:
    """Return a sentence on how the next run continues from kept stages."""
    return (
        f"Finished stages are kept in {folder / STAGES}: the same command continues from there, "
        f"and `pimper clean {folder}` removes them."
    )


@contextmanager
def locked(target: Path, folder: Path) -> Iterator[None]:
    """Lock a result folder for this process; the lock of a killed process is free.

    Args:
        target: The folder with links resolved. It is created with its parents.
        folder: The same as the user named it, for messages.
    """
    # Imported here, as errors in arguments are reported without it.
    from filelock import FileLock, Timeout

    stages = target / STAGES
    holder = stages / HOLDER
    lock = FileLock(stages / LOCK, timeout=0, thread_local=False)
    try:
        stages.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except NotImplementedError as error:
        raise OutputError(f"{folder}: its disk has no locks. Write elsewhere.") from error
    except (Timeout, RuntimeError) as error:  # RuntimeError: this thread has locked it
        owner = "details unknown"
        with suppress(OSError):
            owner = holder.read_text(encoding="utf-8")
        raise OutputError(
            f"{folder}: another run is writing to it: {owner}. Wait until it ends, end it if it "
            "hangs, or write elsewhere."
        ) from error
    except OSError as error:
        raise OutputError(f"{folder}: cannot be locked ({error}). Write elsewhere.") from error
    try:
        with suppress(OSError):  # the disk is full
            command = shlex.join([Path(sys.argv[0] or "python").name, *sys.argv[1:]])
            now = datetime.now().astimezone().isoformat(" ", "minutes")
            owner = f"process {os.getpid()} on {node()} since {now}, `{command}`"
            holder.write_text(owner, encoding="utf-8")
        yield
    finally:
        with suppress(OSError):
            for name in _PASSING:
                (stages / name).unlink(missing_ok=True)
            if [path.name for path in stages.iterdir()] == [LOCK]:  # nothing is kept
                (stages / LOCK).unlink()
                stages.rmdir()
        lock.release()
