"""One object of a batch, and carrying it out wherever a worker stands.

A worker starts ``pimper reconstruct`` as a process of its own, so that a run that is killed, hangs
or takes all memory leaves the worker unharmed. All that driver and workers share is the folder of
the batch. There, in ``.stages``, an object has a lease with the token of the newest try, which any
other try ends at; a log with the events of its runs; and the key of what its result is made from.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from platform import node
from typing import IO, Any, Literal

from filelock import FileLock, Timeout

from pimper_torch.cli.deaths import what_killed
from pimper_torch.doors.outputs.marker import MARKER, STAGES
from pimper_torch.doors.outputs.stages import HOLDER, LOCK

Status = Literal["ended", "failed", "lost", "kept", "waiting"]

# What a child runs: it ends when its parent does, and then is `pimper`.
_CHILD = """
import faulthandler, sys
from pimper_torch.cli.supervise import die_with
die_with(int(sys.argv[1]))
del sys.argv[1]
faulthandler.enable()
from pimper_torch.cli.main import main
sys.exit(main(supervised=True))
"""
# Of errors that another worker, with more memory, may not make.
_OF_MEMORY = ("MemoryError", "OutOfMemoryError")
_LOOK_SECONDS = 0.5
# A choice: a stage's step is longer in large runs, which are killed then; their stages are kept.
_PATIENCE_SECONDS = 10.0
# The lock of a try that does not see its lease withdrawn in this time is taken from it.
_SILENCE_SECONDS = 30.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """Inputs of a worker for one object.

    Attributes:
        arguments: Of ``pimper reconstruct``, with absolute paths.
        key: Hash of the arguments and of all files that are read.
        limit_s: Seconds after which a try is ended.
        avoid: Workers on which earlier tries were lost.
    """

    name: str
    arguments: tuple[str, ...]
    out: Path
    key: str
    limit_s: float
    mem_gb: float
    threads: int
    token: str = ""
    avoid: tuple[str, ...] = ()

    def beside(self, suffix: str) -> Path:
        """Return a file of the object in ``.stages`` of the batch."""
        return self.out.parent / STAGES / f"{self.name}{suffix}"

    @property
    def log(self) -> Path:
        """The events of all tries, a JSON object a line, among what else their runs said."""
        return self.beside(".jsonl")


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """End of a try.

    Attributes:
        status: ``ended`` with a result; ``failed`` by itself, as it will anywhere; ``lost``, as
            another worker may not; ``kept``, as the result was whole before; ``waiting`` where no
            try was begun.
        message: Why there is no result.
        stage: That was under way at the end.
    """

    name: str
    status: Status
    message: str = ""
    place: str = ""
    stage: str = ""
    seconds: float = 0.0
    tries: int = 0


def carry_out(task: Task, place: str = "") -> Outcome:
    """Reconstruct an object in a child process, which writes its events to the task's log.

    Args:
        place: Name of the worker; the host's unless given.
    """
    began, place = time.monotonic(), place or node()
    status, message = _result(task, place, began + task.limit_s)
    seconds = time.monotonic() - began
    return Outcome(name=task.name, status=status, message=message, place=place, seconds=seconds)


def is_whole(task: Task) -> bool:
    """Return whether the object's result is there, of the same arguments and files.

    It is newer than the key that was written before its run, whoever saw how that ended.
    """
    key = task.beside(".key")
    with suppress(OSError):
        written = (task.out / MARKER).stat().st_mtime_ns >= key.stat().st_mtime_ns
        return written and key.read_text(encoding="utf-8") == task.key
    return False


def events(file: IO[bytes]) -> Iterator[dict[str, Any]]:
    """Read events from where a log is open; what else stands there is passed over."""
    while (line := file.readline()).endswith(b"\n"):
        with suppress(ValueError):
            event = json.loads(line)
            if isinstance(event, dict) and "event" in event:
                yield event
    file.seek(-len(line), os.SEEK_CUR)  # a line that is being written


def _result(task: Task, place: str, latest: float) -> tuple[Status, str]:
    with task.log.open("ab+") as log:
        begun = log.seek(0, os.SEEK_END)
        refused = _wait_for_lock(task, log, latest)
        if refused is not None:
            return "lost", refused
        if is_whole(task):
            return "kept", ""
        key = task.beside(".key")
        if not (key.exists() and key.read_text(encoding="utf-8") == task.key):
            key.write_text(task.key, encoding="utf-8")
        child = _start(task, log)
        begins = {"event": "try", "place": place, "host": node(), "process": child.pid}
        log.write(json.dumps(begins).encode() + b"\n")
        log.flush()
        try:
            reason = _wait(task, child, latest)
        finally:
            _end(child)
        if reason is not None:
            return "lost", reason
        log.seek(begun)
        errors = [one for one in events(log) if one["event"] == "error"]
    if child.returncode == 0:
        return "ended", ""
    if child.returncode not in (1, 2) or not errors:
        return "lost", what_killed(child.returncode)
    message, kind = str(errors[-1]["message"]), errors[-1]["kind"]
    return ("lost" if kind in _OF_MEMORY else "failed"), message


def _start(task: Task, log: IO[bytes]) -> "subprocess.Popen[bytes]":
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
        # Ctrl-C in the driver's terminal is the driver's to pass on.
        start_new_session=True,
    )


def _wait(task: Task, child: "subprocess.Popen[bytes]", latest: float) -> str | None:
    """Wait for a run; return why it is to be ended before its end."""
    while True:
        with suppress(subprocess.TimeoutExpired):
            child.wait(_LOOK_SECONDS)
            return None
        if reason := _reason_to_stop(task, latest):
            return reason


def _reason_to_stop(task: Task, latest: float) -> str | None:
    if time.monotonic() > latest:
        return f"it took longer than {task.limit_s / 60:.0f} minutes (`--time-limit`)."
    try:
        held = task.beside(".lease").read_text(encoding="utf-8")
    except FileNotFoundError:
        held = ""
    except OSError:  # a shared folder that is away for a moment
        return None
    return None if held == task.token else "it was stopped."


def _end(child: "subprocess.Popen[bytes]") -> None:
    if child.poll() is None:
        child.terminate()
        with suppress(subprocess.TimeoutExpired):
            child.wait(_PATIENCE_SECONDS)
    child.kill()
    child.wait()


def _wait_for_lock(task: Task, log: IO[bytes], latest: float) -> str | None:
    """Wait until no other run holds the folder of the result; return why it cannot be had.

    A try whose lease is withdrawn ends by itself. One that does not, as its machine hangs, loses
    the lock; what it may write still has the same bits.
    """
    lock = task.out / STAGES / LOCK
    asked = time.monotonic()
    while lock.exists():
        try:
            with FileLock(lock, timeout=0):
                return None
        except Timeout:
            pass
        except (OSError, NotImplementedError):  # of which the run warns
            return None
        if reason := _reason_to_stop(task, latest):
            return f"another run writes to {task.out}; {reason}"
        if time.monotonic() - asked > _SILENCE_SECONDS and _is_ours(lock, log):
            with suppress(OSError):
                lock.unlink()
        time.sleep(_LOOK_SECONDS)
    return None


def _is_ours(lock: Path, log: IO[bytes]) -> bool:
    """Return whether a lock's holder is a run that an earlier try began."""
    with suppress(OSError):
        holder = lock.with_name(HOLDER).read_text(encoding="utf-8")
        log.seek(0)
        tries = [one for one in events(log) if one["event"] == "try"]
        return any(
            holder.startswith(f"process {one['process']} on {one['host']} ") for one in tries
        )
    return False
