"""Many objects, each a task of any ``concurrent.futures.Executor``."""

import secrets
import time
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import shorten
from typing import Any, Protocol, runtime_checkable

from pimper_torch.cli.batches.objects import Object, read_objects
from pimper_torch.cli.batches.plan import planned_batch, runs_at_once
from pimper_torch.cli.batches.table import SIGNS, rows_of, write_table
from pimper_torch.cli.batches.task import Outcome, Task, carry_out, events
from pimper_torch.doors.outputs.files import prepare_file
from pimper_torch.doors.outputs.stages import locked
from pimper_torch.runtime.config import require
from pimper_torch.runtime.cores import usable_cores

TRIES = 3
"""Default number of tries of an object."""

_LOOK_SECONDS = 0.5
# A try ends itself at its limit; a worker that has not by then hangs.
_SILENCE_SECONDS = 60.0
# What engines raise where a worker is gone, by name: none of them need be installed.
_LOST = ("KilledWorker", "UncompletedJobError", "CommClosedError")


@runtime_checkable
class Listener(Protocol):
    """Hears how the objects of a batch come on."""

    def progressed(self, name: str, event: Mapping[str, Any]) -> None:
        """Hear an event of an object's run, or that a ``try`` begins at a ``place``."""

    def settled(self, outcome: Outcome, again: bool) -> None:
        """Hear that a try ended, and whether the object is tried again."""


def batch(
    objects: Path | str | Sequence[Object | Path | str],
    out: Path | str,
    *,
    executor: Executor | None = None,
    settings: Sequence[str] = (),
    overwrite: bool = False,
    jobs: int | None = None,
    tries: int = TRIES,
    time_limit_min: float | None = None,
    mem_gb: float | None = None,
    cpus_per_task: int | None = None,
    listener: Listener | None = None,
) -> tuple[Outcome, ...]:
    """Reconstruct many objects, each in a process of its own, and write a table of them.

    An object whose result is whole, of the same settings and files, is passed over; any other goes
    on from what its stages kept. One that a worker takes down with it is tried again, where the
    engine allows on another worker; one that fails by itself is not, and stops no other.

    Args:
        objects: As of :func:`~pimper_torch.cli.batches.objects.read_objects`.
        out: Folder for a folder of each object's name, ``batch.csv`` and ``batch.html``; workers
            must reach it, and the photographs, under the same path.
        executor: What carries out the tasks; by default processes of this machine.
        jobs: Objects at once: what fits this machine, or 100 of an engine, unless given.
        settings: Options of ``pimper reconstruct`` for every object.
        overwrite: Replace results of other settings or files.
        tries: How often an object is begun whose worker is lost.
        time_limit_min: Minutes that a try may take; ten times the estimate unless given, an hour at
            least.
        mem_gb: Memory that a run takes; an estimate unless given.

    Returns:
        How each object ended, in their order.

    Raises:
        InputError: No objects, or several of one name.
        ConfigError: A wrong setting of one of them.
    """
    require(jobs is None or jobs >= 1, "jobs", jobs, "1 at least")
    require(tries >= 1, "tries", tries, "1 at least")
    limit = time_limit_min
    require(limit is None or limit > 0, "time_limit", limit, "minutes above 0")
    require(mem_gb is None or mem_gb > 0, "mem_gb", mem_gb, "gigabytes above 0")
    require(
        cpus_per_task is None or cpus_per_task >= 1, "cpus_per_task", cpus_per_task, "1 or more"
    )
    out = Path(out)
    # Results of an earlier batch into a folder of the list are none of its objects.
    own = out.resolve()
    found = [
        one for one in read_objects(objects) if not Path(one.photos).resolve().is_relative_to(own)
    ]
    limit_s = None if limit is None else 60 * limit
    plan = planned_batch(found, out, settings, overwrite=overwrite, limit_s=limit_s, mem_gb=mem_gb)
    threads = cpus_per_task or 1
    if executor is None:
        jobs = jobs or runs_at_once([task.mem_gb for task in plan.tasks])
        threads = cpus_per_task or max(1, usable_cores() // jobs)
    tasks = [replace(task, threads=threads) for task in plan.tasks]
    with locked(own, out):
        for name, sign in SIGNS.items():
            prepare_file(out / name, overwrite=True, sign=sign)
        driver = _Driver(executor or ThreadPoolExecutor(jobs), jobs or 100, tries, listener)
        for outcome in plan.settled:
            driver.settle(outcome)
        try:
            driver.drive(tasks)
        finally:
            driver.stop(owned=executor is None)
            order = {one.name: place for place, one in enumerate(found)}
            outcomes = sorted(driver.outcomes, key=lambda one: order[one.name])
            write_table(rows_of(outcomes, out, {one.name: one.photos for one in found}), out)
    return tuple(outcomes)


@dataclass(slots=True, kw_only=True)
class _Try:
    """A task that an engine has.

    Attributes:
        read: Bytes of the log that were read.
        began: When it was seen to have begun; ``None`` before.
    """

    task: Task
    number: int
    read: int
    began: float | None = None
    place: str = ""
    stage: str = ""


class _Driver:
    """Hands tasks to an executor, and those that were lost to it again."""

    def __init__(
        self, executor: Executor, at_once: int, tries: int, listener: Listener | None
    ) -> None:
        self._executor, self._at_once, self._tries = executor, at_once, tries
        self._listener = listener
        self._tasks: Sequence[Task] = ()
        self._waiting: deque[tuple[Task, int]] = deque()
        self._running: dict[Future[Outcome], _Try] = {}
        self.outcomes: list[Outcome] = []

    def drive(self, tasks: Sequence[Task]) -> None:
        """Carry out tasks until each has ended."""
        self._tasks = tasks
        self._waiting.extend((task, 1) for task in tasks)
        while self._waiting or self._running:
            while self._waiting and len(self._running) < self._at_once:
                self._submit(*self._waiting.popleft())
            done, _ = wait(self._running, _LOOK_SECONDS, FIRST_COMPLETED)
            for one in self._running.values():
                self._look(one)
            for future in done:
                one = self._running.pop(future)
                self._end(one, _outcome(future, one))
            for future, one in [*self._running.items()]:
                limit = one.task.limit_s + _SILENCE_SECONDS
                if one.began is not None and time.monotonic() - one.began > limit:
                    del self._running[future]
                    future.cancel()
                    told = (
                        f"{one.place} does not answer any more, during {one.stage or 'its start'}."
                    )
                    self._end(one, _lost(one, told))

    def settle(self, outcome: Outcome, again: bool = False) -> None:
        """Take down how an object ended."""
        if not again:
            self.outcomes.append(outcome)
        if self._listener is not None:
            self._listener.settled(outcome, again)

    def stop(self, owned: bool) -> None:
        """End what runs, and take down what did not end.

        Args:
            owned: Whether the executor is ours, and ends, too.
        """
        for task in self._tasks:  # also of tries that were given up
            with suppress(OSError):
                task.beside(".lease").unlink(missing_ok=True)
        for future in self._running:
            future.cancel()
        if owned:
            self._executor.shutdown(cancel_futures=True)
        left = [(one.task, one.number) for one in self._running.values()]
        for task, number in (*left, *self._waiting):
            told = "interrupted; the same command goes on."
            self.settle(Outcome(name=task.name, status="waiting", message=told, tries=number - 1))
        self._running, self._waiting = {}, deque()

    def _submit(self, task: Task, number: int) -> None:
        task = replace(task, token=secrets.token_hex(8))
        task.beside(".lease").write_text(task.token, encoding="utf-8")
        read = task.log.stat().st_size if task.log.exists() else 0
        try:
            future = self._executor.submit(carry_out, task)
        except Exception as error:  # a broken executor, or one that was closed
            told = f"not begun: the engine takes no more work ({_reason(error)})."
            for other, tried in ((task, number), *self._waiting):
                lost = Outcome(name=other.name, status="waiting", message=told, tries=tried - 1)
                self.settle(lost)
            self._waiting.clear()
            return
        self._running[future] = _Try(task=task, number=number, read=read)

    def _look(self, one: _Try) -> None:
        """Read the events of a run since the last time."""
        with suppress(OSError), one.task.log.open("rb") as log:
            log.seek(one.read)
            for event in events(log):
                if event["event"] == "try":
                    one.began, one.place, one.stage = time.monotonic(), str(event["place"]), ""
                one.stage = str(event.get("stage", one.stage))
                if self._listener is not None:
                    self._listener.progressed(one.task.name, event)
            one.read = log.tell()

    def _end(self, one: _Try, outcome: Outcome) -> None:
        again = outcome.status == "lost" and one.number < self._tries
        if again:
            avoid = (*one.task.avoid, outcome.place)
            self._waiting.append((replace(one.task, avoid=avoid), one.number + 1))
        self.settle(replace(outcome, stage=one.stage, tries=one.number), again)


def _outcome(future: Future[Outcome], one: _Try) -> Outcome:
    """Return how a try ended; what an engine raises is a loss where a worker is gone."""
    try:
        return future.result()
    except (BrokenExecutor, CancelledError, OSError) as error:
        return _gone(one, error)
    except Exception as error:
        if type(error).__name__ in _LOST:
            return _gone(one, error)
        told = f"the worker{_on(one)} cannot carry it out ({_reason(error)})."
        return Outcome(name=one.task.name, status="failed", message=told, place=one.place)


def _gone(one: _Try, error: BaseException) -> Outcome:
    if one.began is None:
        return _lost(one, f"the engine lost it before it began ({_reason(error)}).")
    during = f" during {one.stage}" if one.stage else ""
    return _lost(one, f"the worker{_on(one)} was lost{during} ({_reason(error)}).")


def _lost(one: _Try, told: str) -> Outcome:
    seconds = 0.0 if one.began is None else time.monotonic() - one.began
    return Outcome(
        name=one.task.name, status="lost", message=told, place=one.place, seconds=seconds
    )


def _on(one: _Try) -> str:
    return f" {one.place}" if one.place else ""


def _reason(error: BaseException) -> str:
    text = shorten(str(error), 300, placeholder=" ...").rstrip(".")
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
