"""``pimper batch``: reconstruct many objects, on this machine or on a cluster."""

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from pimper_torch.cli.arguments import Flag, read_arguments
from pimper_torch.cli.batches.engines import SlurmExecutor, dask_workers
from pimper_torch.cli.batches.many_objects import batch
from pimper_torch.cli.batches.objects import CSV, HTML
from pimper_torch.cli.batches.task import Outcome
from pimper_torch.cli.output import Output
from pimper_torch.cli.stopping import Stopped, exit_code
from pimper_torch.export.result_folder.marker import STAGES
from pimper_torch.runtime.config import require
from pimper_torch.runtime.errors import ReconstructionError


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    """Reconstruct many objects, each with `pimper reconstruct`.

    Arguments after `--` are passed to it for every object: `-- --preset fast`. Objects with a
    complete result are skipped; others continue after their last finished stage.

    Attributes:
        list: Folder with a folder of photographs per object, or a CSV file with columns `photos`,
            `name` and options of `pimper reconstruct`.
        out: Folder for batch.csv, batch.html and a folder per object.
        overwrite: Replace results of other settings or photographs.
        jobs: Number of simultaneous objects; by default as many as fit, or 100 on Slurm.
        dask: Address of a dask.distributed scheduler to run on, such as tcp://127.0.0.1:8786.
        slurm: Slurm partition whose nodes run the objects, one job per object.
        time_limit: Minutes per try; by default ten times the estimate, at least an hour.
        mem_gb: Memory of a run; estimated by default.
        cpus_per_task: Threads of a run; by default an equal share of the cores, or 1 on a cluster.
    """

    list: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="LIST")]
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    overwrite: Flag = False
    jobs: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    dask: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = ""
    slurm: Annotated[str, tyro.conf.arg(metavar="PARTITION")] = ""
    time_limit: Annotated[float | None, tyro.conf.arg(aliases=["--timeout-min"], metavar="MIN")] = (
        None
    )
    mem_gb: Annotated[float | None, tyro.conf.arg(metavar="GB")] = None
    cpus_per_task: Annotated[int | None, tyro.conf.arg(metavar="N")] = None


def run(given: tuple[_Job, list[str]], output: Output) -> None:
    """Run ``batch``: print a line per object, and the path of the table."""
    job, settings = given

    def show(outcome: Outcome) -> None:
        output.event("object-end", **asdict(outcome))
        line = f"{outcome.name:<24} {outcome.status:<8}{outcome.seconds:8.1f} s"
        output.remark(f"{line}{outcome.place and f' on {outcome.place}'} {outcome.message}")

    engine: AbstractContextManager[Executor | None] = nullcontext()
    if job.dask:
        engine = dask_workers(job.dask)
    if job.slurm:
        engine = SlurmExecutor(job.out / STAGES / "slurm", job.jobs or 100, job.slurm)
    try:
        with engine as executor:
            outcomes = batch(
                job.list,
                job.out,
                executor=executor,
                settings=settings,
                overwrite=job.overwrite,
                jobs=None if job.slurm else job.jobs,
                time_limit_min=job.time_limit,
                mem_gb=job.mem_gb,
                cpus_per_task=job.cpus_per_task,
                listener=show,
            )
    except KeyboardInterrupt as error:
        left = f"finished objects are complete; {job.out / CSV} lists all. {_CONTINUES}"
        raise Stopped(exit_code(error) - 128, left) from error
    counts = Counter(outcome.status for outcome in outcomes)
    totals = ", ".join(f"{count} {status}" for status, count in counts.items())
    output.remark(f"{totals}; {job.out / HTML} shows them.")
    if failed := [outcome for outcome in outcomes if outcome.status not in ("ended", "kept")]:
        raise ReconstructionError(
            f"{len(failed)} of {len(outcomes)} objects have no result. {job.out / CSV} lists them "
            f"with their reasons. {_CONTINUES}"
        )
    paths = {"folder": job.out, CSV: job.out / CSV, HTML: job.out / HTML}
    output.result(paths, objects=len(outcomes))


_CONTINUES = "The same command continues after the finished stages."


def checked(command: str, arguments: Sequence[str]) -> tuple[_Job, list[str]]:
    """Return the arguments, and those after ``--`` for every object."""
    options, settings = [*arguments], []
    if "--" in options:
        index = options.index("--")
        options, settings = options[:index], options[index + 1 :]
    job = read_arguments(_Job, command, options)
    require(not (job.dask and job.slurm), "--slurm", job.slurm, "no value together with --dask")
    require(job.jobs is None or job.jobs >= 1, "--jobs", job.jobs, "at least 1")
    return job, settings
