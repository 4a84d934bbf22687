"""``pimper batch``: many objects, on this machine or on an engine."""

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
from pimper_torch.doors.result_folder.marker import STAGES
from pimper_torch.runtime.config import require
from pimper_torch.runtime.errors import ReconstructionError


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    """Reconstruct many objects, each as `pimper reconstruct` does.

    Arguments after `--` are passed to it for every object: `-- --preset fast`. An object whose
    result is whole is passed over, others go on from what their stages kept.

    Attributes:
        list: Folder of folders of photographs, or a CSV file with columns `photos`, `name` and
            options of `pimper reconstruct`.
        out: Folder for a folder of each object, batch.csv and batch.html.
        overwrite: Replace results of other settings or photographs.
        jobs: Objects at once; as many as memory and cores allow unless given, 100 of Slurm.
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
    dask: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = ""
    slurm: Annotated[str, tyro.conf.arg(metavar="PARTITION")] = ""
    time_limit: Annotated[float | None, tyro.conf.arg(aliases=["--timeout-min"], metavar="MIN")] = (
        None
    )
    mem_gb: Annotated[float | None, tyro.conf.arg(metavar="GB")] = None
    cpus_per_task: Annotated[int | None, tyro.conf.arg(metavar="N")] = None


def run(given: tuple[_Job, list[str]], output: Output) -> None:
    """Carry out ``batch``: a line an object, and at the end where the table is."""
    job, settings = given

    def show(one: Outcome) -> None:
        output.event("object-end", **asdict(one))
        place = f" on {one.place}" if one.place else ""
        output.remark(f"{one.name:<24} {one.status:<8}{one.seconds:8.1f} s{place} {one.message}")

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
        left = f"objects that ended are whole, {job.out / CSV} lists all. {_GOES_ON}"
        raise Stopped(exit_code(error) - 128, left) from error
    counts = Counter(one.status for one in outcomes)
    totals = ", ".join(f"{count} {status}" for status, count in counts.items())
    output.remark(f"{totals}; {job.out / HTML} shows them.")
    if lost := [one for one in outcomes if one.status not in ("ended", "kept")]:
        first = lost[0]
        raise ReconstructionError(
            f"{len(lost)} of {len(outcomes)} objects have no result, as {first.name}: "
            f"{first.message} {job.out / CSV} lists all with their reasons. {_GOES_ON}"
        )
    paths = {"folder": job.out, CSV: job.out / CSV, HTML: job.out / HTML}
    output.result(paths, objects=len(outcomes))


_GOES_ON = "The same command goes on: what stages finished is kept."


def checked(command: str, arguments: Sequence[str]) -> tuple[_Job, list[str]]:
    """Read the arguments, and those behind ``--`` for every object."""
    own, settings = [*arguments], []
    if "--" in own:
        place = own.index("--")
        own, settings = own[:place], own[place + 1 :]
    job = read_arguments(_Job, command, own)
    require(not (job.dask and job.slurm), "--slurm", job.slurm, "none beside --dask")
    require(job.jobs is None or job.jobs >= 1, "--jobs", job.jobs, "1 at least")
    return job, settings
