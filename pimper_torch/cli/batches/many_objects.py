"""Reconstruction of many objects, as tasks of any ``concurrent.futures.Executor``."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, as_completed
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path

from pimper_torch.cli.batches.objects import Object, read_objects
from pimper_torch.cli.batches.plan import planned_batch, runs_at_once
from pimper_torch.cli.batches.table import SIGNS, write_table
from pimper_torch.cli.batches.task import STOPPED, Outcome, Task, lost, outcome_of
from pimper_torch.export.result_folder.files import prepare_file
from pimper_torch.export.result_folder.stages import locked
from pimper_torch.runtime.config import require
from pimper_torch.runtime.cores import usable_cores


def batch(
    objects: Path | str | Sequence[Object | Path | str],
    out: Path | str,
    *,
    executor: Executor | None = None,
    settings: Sequence[str] = (),
    overwrite: bool = False,
    jobs: int | None = None,
    time_limit_min: float | None = None,
    mem_gb: float | None = None,
    cpus_per_task: int | None = None,
    listener: Callable[[Outcome], None] | None = None,
) -> tuple[Outcome, ...]:
    """Reconstruct many objects, each in a separate process, and write a table of outcomes.

    An object with a complete result of the same settings and files is skipped; others continue
    after their last finished stage. A run that is killed, hangs or lacks memory is tried up to
    three times; a run that fails with an error is not repeated and does not stop others. An object
    whose folder is locked by another run is left waiting, with a message that names that run.

    Args:
        objects: As for :func:`~pimper_torch.cli.batches.objects.read_objects`.
        out: Folder for ``batch.csv``, ``batch.html`` and a folder per object; workers must see it,
            and the photographs, under the same path.
        executor: Executor of the tasks; by default processes on this machine.
        jobs: Number of simultaneous objects; by default as many as fit. Only without executor.
        settings: Options of ``pimper reconstruct`` for every object.
        overwrite: Replace results of other settings or files.
        time_limit_min: Minutes per try; by default ten times the estimate, at least an hour.
        mem_gb: Memory of a run; estimated by default.
        cpus_per_task: Threads of a run; by default an equal share of the cores, 1 with an executor.
        listener: Called with the outcome of each object as soon as it ends.

    Returns:
        The outcomes in the order of the objects.

    Raises:
        InputError: No objects, or several with one name.
        ConfigError: An object has an invalid setting.
    """
    require(jobs is None or executor is None, "jobs", jobs, "no value together with an executor")
    positive = {"jobs": jobs, "time_limit_min": time_limit_min}
    positive |= {"mem_gb": mem_gb, "cpus_per_task": cpus_per_task}
    for name, value in positive.items():
        require(value is None or value > 0, name, value, "more than 0")
    out = Path(out).absolute()
    items = [
        item  # if OUT is inside the listed folder, results of an earlier batch are not objects
        for item in read_objects(objects)
        if not Path(item.photos).resolve().is_relative_to(out.resolve())
    ]
    limits = {"limit_s": 60 * (time_limit_min or 0), "mem_gb": mem_gb or 0}
    plan = planned_batch(items, out, settings, overwrite=overwrite, **limits)
    if executor is None:
        jobs = jobs or runs_at_once([entry.mem_gb for entry in plan if isinstance(entry, Task)])
        cpus_per_task = cpus_per_task or max(1, usable_cores() // jobs)
    threads = cpus_per_task or 1
    plan = [replace(e, threads=threads) if isinstance(e, Task) else e for e in plan]
    engine = ThreadPoolExecutor(jobs) if executor is None else nullcontext(executor)
    return _settled(plan, {item.name: item.photos for item in items}, out, engine, listener)


def _settled(
    plan: Sequence[Task | Outcome],
    photos: Mapping[str, Path | str],
    out: Path,
    engine: AbstractContextManager[Executor],
    listener: Callable[[Outcome], None] | None,
) -> tuple[Outcome, ...]:
    """Run the tasks of a plan, and write the table of all outcomes, also if interrupted."""
    outcomes: dict[str, Outcome] = {}

    def settle(outcome: Outcome) -> None:
        outcomes[outcome.name] = outcome
        if listener is not None:
            listener(outcome)

    with locked(out.resolve(), out):
        for name, sign in SIGNS.items():
            prepare_file(out / name, overwrite=True, sign=sign)
        try:
            for entry in plan:
                if isinstance(entry, Outcome):
                    settle(entry)
            with engine as executor:
                _run_all(executor, [task for task in plan if isinstance(task, Task)], settle)
        finally:
            message = "interrupted; the same command continues."
            ended = tuple(
                outcomes.get(name) or Outcome(name=name, status="waiting", message=message)
                for name in photos
            )
            write_table(ended, out, photos)
    return ended


def _run_all(executor: Executor, tasks: Sequence[Task], settle: Callable[[Outcome], None]) -> None:
    """Run all tasks, and settle each when it ends; an error, or Ctrl-C, stops running tasks."""
    futures: dict[Future[Outcome], Task] = {}
    STOPPED.difference_update(task.out.parent for task in tasks)
    try:
        for task in tasks:
            futures[executor.submit(outcome_of, task)] = task
        for future in as_completed(futures):
            try:
                outcome = future.result()
            except Exception as error:  # raised by the engine
                outcome = lost(futures[future], error)
            settle(outcome)
    except BaseException:
        STOPPED.update(task.out.parent for task in tasks)
        for future in futures:
            future.cancel()
        raise
