"""``pimper batch``: many objects, on this machine or on an engine."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn

from pimper_torch.cli.arguments import Flag, read_arguments
from pimper_torch.cli.batches.engines import (
    SlurmExecutor,
    dask_workers,
    require_dask,
    require_slurm,
)
from pimper_torch.cli.batches.many_objects import TRIES, Listener, batch
from pimper_torch.cli.batches.objects import CSV, HTML
from pimper_torch.cli.batches.table import terminal
from pimper_torch.cli.batches.task import Outcome
from pimper_torch.cli.output import Output
from pimper_torch.cli.supervise import Stopped, exit_code
from pimper_torch.doors.outputs.marker import STAGES
from pimper_torch.runtime.config import require
from pimper_torch.runtime.errors import ReconstructionError


def totals(outcomes: Sequence[Outcome]) -> str:
    """Count objects by how they ended.

    >>> totals([Outcome(name="a", status="ended"), Outcome(name="b", status="failed")])
    '1 ended, 1 failed'
    """
    counts = Counter(one.status for one in outcomes)
    return ", ".join(f"{count} {status}" for status, count in counts.items())


class TryEvents:
    """Writes an event when a try begins and ends, and at every stage of it."""

    def __init__(self, write: Callable[..., None]) -> None:
        self._write = write

    def progressed(self, name: str, event: Mapping[str, Any]) -> None:
        """Write where a try begins, and its stages."""
        if event["event"] == "try":
            self._write("object-begin", name=name, place=event["place"])
        elif event["event"] == "stage-begin":
            left = event.get("seconds_left")
            self._write("object-stage", name=name, stage=event["stage"], seconds_left=left)

    def settled(self, outcome: Outcome, again: bool) -> None:
        """Write how a try ended."""
        self._write(
            "object-end",
            name=outcome.name,
            status=outcome.status,
            message=outcome.message,
            place=outcome.place,
            tries=outcome.tries,
            seconds=round(outcome.seconds, 1),
            again=again,
        )


class Lines:
    """Shows a line for every object that runs, and one that stays for each that ended.

    Where the output is no terminal, only the latter.
    """

    def __init__(self, shown: bool) -> None:
        self._console = Console(stderr=True, quiet=not shown)
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),  # whose names may have brackets
            TextColumn("{task.fields[about]}", style="dim", markup=False),
            TimeElapsedColumn(),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._lines: dict[str, TaskID] = {}

    def __enter__(self) -> "Lines":
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def progressed(self, name: str, event: Mapping[str, Any]) -> None:
        """Show the stage of an object, where it runs and the time left."""
        if event["event"] == "try":
            self._forget(name)
            about = f"on {event['place']}"
            self._lines[name] = self._progress.add_task(name, total=None, about=about)
        if event["event"] in ("stage-begin", "progress") and name in self._lines:
            seconds = event.get("seconds_left")
            left = "" if seconds is None else f", about {seconds:.0f} s left"
            self._progress.update(self._lines[name], about=f"{event['stage']}{left}")

    def settled(self, outcome: Outcome, again: bool) -> None:
        """Show how a try ended, in a line that stays."""
        self._forget(outcome.name)
        told = f"{outcome.status}, is tried again" if again else outcome.status
        where = f" on {outcome.place}" if outcome.place else ""
        line = f"{outcome.name:<24} {told:<10} {outcome.seconds:8.1f} s{where} {outcome.message}"
        self._console.print(line.rstrip(), highlight=False, markup=False, soft_wrap=True)

    def _forget(self, name: str) -> None:
        if name in self._lines:
            self._progress.remove_task(self._lines.pop(name))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    """Reconstruct many objects, each as `pimper reconstruct` does.

    Arguments after `--` are passed to it for every object: `-- --preset fast`. An object whose
    result is whole is passed over, others go on from what their stages kept.

    Attributes:
        list: Folder of folders of photographs, a pattern in quotes such as 'scans/*/photos', or a
            CSV file with columns `photos`, `name` and options of `pimper reconstruct`.
        out: Folder for a folder of each object, batch.csv and batch.html.
        overwrite: Replace results of other settings or photographs.
        jobs: Objects at once; as many as memory and cores allow unless given, 100 on an engine.
        tries: How often an object is begun whose run is killed, hangs or lacks memory.
        dask: Scheduler of dask.distributed whose workers do it, such as tcp://127.0.0.1:8786.
        slurm: Partition of Slurm whose nodes do it, a job an object.
        time_limit: Minutes of one try; ten times the estimate unless given, an hour at least.
        mem_gb: Memory of a run; an estimate unless given.
        cpus_per_task: Threads of a run; here the cores shared out, on an engine 1 unless given.
    """

    list: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="LIST")]
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    overwrite: Flag = False
    jobs: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    tries: int = TRIES
    dask: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = ""
    slurm: Annotated[str, tyro.conf.arg(metavar="PARTITION")] = ""
    time_limit: Annotated[float | None, tyro.conf.arg(aliases=["--timeout-min"], metavar="MIN")] = (
        None
    )
    mem_gb: Annotated[float | None, tyro.conf.arg(metavar="GB")] = None
    cpus_per_task: Annotated[int | None, tyro.conf.arg(metavar="N")] = None


def run(given: tuple[_Job, list[str]], output: Output) -> None:
    """Carry out ``batch``: a line an object, and a table at the end."""
    job, settings = given
    shown: AbstractContextManager[Listener] = Lines(output.shows("info"))
    shown = nullcontext(TryEvents(output.event)) if output.as_json else shown
    try:
        with _engine(job) as executor, shown as listener:
            outcomes = batch(
                job.list,
                job.out,
                executor=executor,
                settings=settings,
                overwrite=job.overwrite,
                jobs=job.jobs,
                tries=job.tries,
                time_limit_min=job.time_limit,
                mem_gb=job.mem_gb,
                cpus_per_task=job.cpus_per_task,
                listener=listener,
            )
    except KeyboardInterrupt as error:
        left = f"objects that ended are whole, {job.out / CSV} lists all. {_GOES_ON}"
        raise Stopped(exit_code(error) - 128, left) from error
    output.remark(f"{terminal(job.out)}\n{totals(outcomes)}; {job.out / HTML} shows them.")
    lost = [one for one in outcomes if one.status not in ("ended", "kept")]
    if lost:
        first = lost[0]
        raise ReconstructionError(
            f"{len(lost)} of {len(outcomes)} objects have no result, as {first.name}: "
            f"{first.message} {job.out / CSV} lists all with their reasons. {_GOES_ON}"
        )
    paths = {"folder": job.out, CSV: job.out / CSV, HTML: job.out / HTML}
    output.result(paths, objects=len(outcomes))


_GOES_ON = "The same command goes on: what stages finished is kept."


@contextmanager
def _engine(job: _Job) -> Iterator[Executor | None]:
    """Return what carries out the objects; ``None`` is this machine."""
    if job.dask:
        with dask_workers(job.dask) as workers:
            yield workers
    elif job.slurm:
        with SlurmExecutor(job.out / STAGES / "slurm", job.slurm) as jobs:
            yield jobs
    else:
        yield None


def checked(command: str, arguments: Sequence[str]) -> tuple[_Job, list[str]]:
    """Read the arguments, and those behind ``--`` for every object."""
    own, settings = [*arguments], []
    if "--" in own:
        place = own.index("--")
        own, settings = own[:place], own[place + 1 :]
    job = read_arguments(_Job, command, own)
    require(not (job.dask and job.slurm), "--slurm", job.slurm, "none beside --dask")
    if job.dask:
        require_dask()
    if job.slurm:
        require_slurm()
    return job, settings
