"""One object of a batch, and its reconstruction by a worker on any machine.

A worker starts ``pimper reconstruct`` as a child process, so a run that is killed, hangs or uses up
the memory does not harm the worker. Driver and workers share only the folder of the batch. Its
``.stages`` contains a log of each object's events, and a key of the inputs of its result. The lock
is that of the result's folder, and is never broken.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from platform import node
from textwrap import shorten
from typing import IO, Literal

from pimper_torch.cli.supervise import what_killed
from pimper_torch.export.result_folder.marker import MARKER, STAGES
from pimper_torch.export.result_folder.stages import locked
from pimper_torch.runtime.errors import OutputError

Status = Literal["ended", "failed", "lost", "kept", "waiting"]

STOPPED: set[Path] = set()
"""Folders of interrupted batches, whose runs in this process must end."""

# Program of a child: `pimper`, which ends with its parent.
_CHILD = """
import faulthandler, sys
from pimper_torch.cli.supervise import exit_with_parent
exit_with_parent(int(sys.argv[1]))
del sys.argv[1]
faulthandler.enable()
from pimper_torch.cli.main import main
sys.exit(main())
"""
# Errors that a worker with more memory may avoid.
_OF_MEMORY = ("MemoryError", "OutOfMemoryError")
_TRIES = 3  # chosen by hand
_LOOK_SECONDS = 0.5
_PATIENCE_SECONDS = 10.0  # chosen by hand
# Chosen by hand: a step of a large run takes longer, and the run is then killed; finished stages
# are kept. The batch itself has four seconds to end.
_END_SECONDS = 2.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """Inputs of a worker for one object.

    Attributes:
        arguments: Arguments of ``pimper``, with absolute paths.
        key: Options and all input files, as JSON.
        limit_s: Time limit of a try in seconds.
    """

    name: str
    arguments: tuple[str, ...]
    out: Path
    key: str
    limit_s: float
    mem_gb: float
    threads: int = 1

    def beside(self, suffix: str) -> Path:
        """Return the path of a file of the object in ``.stages`` of the batch."""
        return self.out.parent / STAGES / f"{self.name}{suffix}"

    def made_from(self) -> str:
        """Return the key of the latest run, written at its start; empty without a run."""
        path = self.beside(".key")
        return path.read_text(encoding="utf-8") if path.exists() else ""

    @property
    def stopped(self) -> bool:
        """Whether the batch was interrupted in this process."""
        return self.out.parent in STOPPED


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """End of a try.

    Attributes:
        status: ``ended`` with a result; ``failed`` with an error that will recur; ``lost`` if a new
            try may succeed; ``kept`` with an earlier complete result; ``waiting`` without a try.
        message: Reason for a missing result.
        place: Host name of the worker.
    """

    name: str
    status: Status
    message: str = ""
    place: str = ""
    seconds: float = 0.0
    tries: int = 0


def outcome_of(task: Task, attempt: Callable[[Task], Outcome] | None = None) -> Outcome:
    """Return the outcome of an object; lost runs are tried again.

    Args:
        attempt: Function for one try; by default :func:`attempted`.
    """
    for number in count(1):
        try:
            outcome = (attempt or attempted)(task)
        except Exception as error:
            outcome = lost(task, error)
        if outcome.status != "lost" or number == _TRIES or task.stopped:
            break
    return replace(outcome, tries=number)


def lost(task: Task, error: Exception) -> Outcome:
    """Return the outcome of a task whose engine or worker raised an error."""
    reason = f"{type(error).__name__}: {shorten(str(error), 300, placeholder=' ...')}"
    message = f"its worker was lost, or cannot run it ({reason.rstrip('.: ')})."
    return Outcome(name=task.name, status="lost", message=message)


def attempted(task: Task) -> Outcome:
    """Return the outcome of one try, in a child process that writes events to the task's log."""
    began = time.monotonic()
    status, message = _tried(task, began + task.limit_s)
    seconds = time.monotonic() - began
    return Outcome(name=task.name, status=status, message=message, place=node(), seconds=seconds)


def is_whole(task: Task) -> bool:
    """Return whether the object has a complete result of the same arguments and files.

    A complete result is newer than the key, which is written before the run.
    """
    with suppress(OSError):
        marker, key = (path.stat() for path in (task.out / MARKER, task.beside(".key")))
        return marker.st_mtime_ns >= key.st_mtime_ns and task.made_from() == task.key
    return False


def _tried(task: Task, latest: float) -> tuple[Status, str]:
    deadline = time.monotonic() + _PATIENCE_SECONDS  # the run of a dead worker may still end
    while True:
        try:
            with locked(task.out, task.out):
                if is_whole(task):
                    return "kept", ""
                if task.made_from() != task.key:
                    task.beside(".key").write_text(task.key, encoding="utf-8")
            break
        except OutputError as error:  # a different run has the lock
            if time.monotonic() > deadline:
                return "waiting", f"not started: {error}"
            time.sleep(_LOOK_SECONDS)
    with task.beside(".jsonl").open("ab+") as log:
        begun = log.seek(0, os.SEEK_END)
        child = _started(task, log)
        try:
            while child.poll() is None and not task.stopped and time.monotonic() < latest:
                with suppress(subprocess.TimeoutExpired):
                    child.wait(_LOOK_SECONDS)
            code = child.poll()
        finally:
            if child.poll() is None:
                child.terminate()
                with suppress(subprocess.TimeoutExpired):
                    child.wait(_END_SECONDS)
            child.kill()
            child.wait()
        log.seek(begun)
        errors = [json.loads(line) for line in log if line.startswith(b'{"event": "error"')]
    if code == 0:
        return "ended", ""
    if code is None:
        limit = f"it took longer than {task.limit_s / 60:.0f} minutes (`--time-limit`)."
        return "lost", "it was stopped." if task.stopped else limit
    if code not in (1, 2) or not errors:
        return "lost", what_killed(code)
    return "lost" if errors[-1]["kind"] in _OF_MEMORY else "failed", str(errors[-1]["message"])


def _started(task: Task, log: IO[bytes]) -> "subprocess.Popen[bytes]":
    path = [str(Path(__file__).parents[3]), os.environ.get("PYTHONPATH", "")]
    return subprocess.Popen(
        [sys.executable, "-c", _CHILD, str(os.getpid()), *task.arguments],
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=log,
        env=os.environ
        | {
            "PYTHONPATH": os.pathsep.join(filter(None, path)),
            "PYTHONSAFEPATH": "1",
            "OMP_NUM_THREADS": str(task.threads),
        },
        # Only the driver receives Ctrl-C in its terminal; it passes it on.
        start_new_session=True,
    )
