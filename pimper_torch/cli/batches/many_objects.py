"""Many objects, each a task of any ``concurrent.futures.Executor``."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, as_completed
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

from pimper_torch.cli.batches.objects import Object, read_objects
from pimper_torch.cli.batches.plan import planned_batch, runs_at_once
from pimper_torch.cli.batches.table import SIGNS, write_table
from pimper_torch.cli.batches.task import STOPPED, Outcome, Task, carry_out, lost
from pimper_torch.doors.result_folder.files import prepare_file
from pimper_torch.doors.result_folder.stages import locked
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
    """Reconstruct many objects, each in a process of its own, and write a table of them.

    An object whose result is whole, of the same settings and files, is passed over; any other goes
    on from what its stages kept. A run that is killed, hangs or lacks memory is tried again, three
    times in all; one that fails by itself is not, and stops no other. An object whose folder
    another run holds is left waiting, with a message that names that run.

    Args:
        objects: As of :func:`~pimper_torch.cli.batches.objects.read_objects`.
        out: Folder for a folder of each object's name, ``batch.csv`` and ``batch.html``; workers
            must reach it, and the photographs, under the same path.
        executor: What carries out the tasks; by default processes of this machine.
        jobs: Objects at once on this machine: as many as fit it unless given. An executor has a
            number of its own.
        settings: Options of ``pimper reconstruct`` for every object.
        overwrite: Replace results of other settings or files.
        time_limit_min: Minutes that a try may take; ten times the estimate unless given, an hour at
            least.
        mem_gb: Memory that a run takes; an estimate unless given.
        cpus_per_task: Threads of a run; the cores shared out unless given, 1 with an executor.
        listener: Is called with how each object ended, at once.

    Returns:
        How each object ended, in their order.

    Raises:
        InputError: No objects, or several of one name.
        ConfigError: A wrong setting of one of them.
    """
    require(jobs is None or executor is None, "jobs", jobs, "none where an executor has its own")
    for name, value in (
        ("jobs", jobs),
        ("time_limit_min", time_limit_min),
        ("mem_gb", mem_gb),
        ("cpus_per_task", cpus_per_task),
    ):
        require(value is None or value > 0, name, value, "more than 0")
    out = Path(out).absolute()
    # Results of an earlier batch into a folder of the list are none of its objects.
    found = [
        one
        for one in read_objects(objects)
        if not Path(one.photos).resolve().is_relative_to(out.resolve())
    ]
    plan = planned_batch(found, out, settings, overwrite=overwrite)
    tasks = [one for one in plan if isinstance(one, Task)]
    threads = cpus_per_task or 1
    if executor is None:
        jobs = jobs or runs_at_once([mem_gb or task.mem_gb for task in tasks])
        threads = cpus_per_task or max(1, usable_cores() // jobs)
    tasks = [
        replace(
            task,
            limit_s=60 * time_limit_min if time_limit_min else task.limit_s,
            mem_gb=mem_gb or task.mem_gb,
            threads=threads,
        )
        for task in tasks
    ]
    outcomes: dict[str, Outcome] = {}

    def settle(outcome: Outcome) -> None:
        outcomes[outcome.name] = outcome
        if listener is not None:
            listener(outcome)

    with locked(out.resolve(), out):
        for name, sign in SIGNS.items():
            prepare_file(out / name, overwrite=True, sign=sign)
        try:
            for one in plan:
                if isinstance(one, Outcome):
                    settle(one)
            with ThreadPoolExecutor(jobs) if executor is None else nullcontext(executor) as engine:
                _carry_out_all(engine, tasks, settle)
        finally:
            message = "interrupted; the same command goes on."
            ended = tuple(
                outcomes.get(one.name) or Outcome(name=one.name, status="waiting", message=message)
                for one in found
            )
            write_table(ended, out, {one.name: one.photos for one in found})
    return ended


def _carry_out_all(
    executor: Executor, tasks: Sequence[Task], settle: Callable[[Outcome], None]
) -> None:
    """Settle each task as it ends; an error, as of Ctrl-C, ends what runs in this process."""
    futures: dict[Future[Outcome], Task] = {}
    STOPPED.difference_update(task.out.parent for task in tasks)
    try:
        for task in tasks:
            futures[executor.submit(carry_out, task)] = task
        for future in as_completed(futures):
            try:
                outcome = future.result()
            except Exception as error:  # of the engine
                outcome = lost(futures[future], error)
            settle(outcome)
    except BaseException:
        STOPPED.update(task.out.parent for task in tasks)
        for future in futures:
            future.cancel()
        raise
