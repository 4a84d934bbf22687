"""Engines of a batch: workers of ``dask.distributed``, and jobs of Slurm by ``submitit``."""

import math
import os
import shutil
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from platform import node
from typing import TYPE_CHECKING

from pimper_torch.cli.batches.task import Outcome, Task
from pimper_torch.runtime.errors import ConfigError, caution

if TYPE_CHECKING:
    from distributed import Client

_TIMEOUT_SECONDS = 10  # a choice


class DaskExecutor(Executor):
    """Hands tasks to the workers of a client's scheduler, rather not where they were lost."""

    def __init__(self, client: "Client") -> None:
        self._client = client

    def submit(  # type: ignore[override]
        self, work: Callable[[Task, str], Outcome], task: Task
    ) -> Future[Outcome]:
        """Schedule a task; a worker that dies has it scheduled elsewhere by Dask itself."""
        others = [one for one in self._client.nthreads() if one not in task.avoid]
        chosen = {"workers": others, "allow_other_workers": True} if task.avoid and others else {}
        executor = self._client.get_executor(pure=False, **chosen)
        future: Future[Outcome] = executor.submit(_at_worker, work, task)
        return future


def _at_worker(work: Callable[[Task, str], Outcome], task: Task) -> Outcome:
    from distributed import get_worker

    return work(task, get_worker().address)


@contextmanager
def dask_workers(address: str) -> Iterator[DaskExecutor]:
    """Connect to a scheduler for the block.

    Raises:
        ConfigError: ``distributed`` is not installed, or no scheduler answers.
    """
    require_dask()
    from distributed import Client

    try:
        client = Client(address, timeout=_TIMEOUT_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"--dask is {address}, where no scheduler answers ({type(error).__name__}: {error}). "
            "Start one (`dask scheduler --host 127.0.0.1`), or give its address, such as "
            "tcp://127.0.0.1:8786."
        ) from error
    with client:
        if not client.nthreads():
            caution(f"{address}: the scheduler has no workers yet; objects wait for them.")
        yield DaskExecutor(client)


def require_dask() -> None:
    """Refuse to go on without ``distributed``."""
    if find_spec("distributed") is None:
        raise ConfigError(
            "--dask needs dask.distributed, which is not installed: pip install "
            "'pimper_torch[dask]'."
        )


if TYPE_CHECKING:
    from submitit import Job


class SlurmExecutor(Executor):
    """A job for every task, which asks for its time, memory and threads.

    Args:
        folder: Where submitit keeps tasks, outcomes and logs; every node must reach it.
        partition: Of Slurm; its own default where empty.
        cluster: Of submitit: ``local`` runs jobs on this machine, to try it out.
    """

    def __init__(self, folder: Path | str, partition: str = "", cluster: str = "slurm") -> None:
        require_slurm(cluster)
        from submitit import AutoExecutor

        self._executor = AutoExecutor(folder=folder, cluster=cluster)
        self._partition = partition
        self._jobs: dict[Future[Outcome], Job[Outcome]] = {}
        self._lock, self._closed = threading.Lock(), threading.Event()
        threading.Thread(target=self._watch, daemon=True).start()

    def submit(  # type: ignore[override]
        self, work: Callable[[Task, str], Outcome], task: Task
    ) -> Future[Outcome]:
        """Submit a job, not to nodes where the task was lost."""
        self._executor.update_parameters(
            name="pimper",
            # The task ends by itself at its limit.
            timeout_min=math.ceil(task.limit_s / 60) + 5,
            mem_gb=math.ceil(task.mem_gb),
            cpus_per_task=task.threads,
            slurm_partition=self._partition or None,
            slurm_exclude=",".join(dict.fromkeys(filter(None, task.avoid))) or None,
        )
        future: Future[Outcome] = Future()
        job = self._executor.submit(_at_node, work, task)
        with self._lock:
            self._jobs[future] = job
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Look at jobs no more."""
        self._closed.set()

    def _watch(self) -> None:
        while not self._closed.wait(1.0):
            with self._lock:
                jobs = [*self._jobs.items()]
            for future, job in jobs:
                if not future.cancelled() and not job.done():
                    continue
                with self._lock:
                    del self._jobs[future]
                if not future.set_running_or_notify_cancel():
                    job.cancel(check=False)
                elif error := job.exception():
                    future.set_exception(error)
                else:
                    future.set_result(job.result())


def _at_node(work: Callable[[Task, str], Outcome], task: Task) -> Outcome:
    return work(task, os.environ.get("SLURMD_NODENAME", node()))


def require_slurm(cluster: str = "slurm") -> None:
    """Refuse to go on without submitit, or without Slurm's commands."""
    if find_spec("submitit") is None:
        raise ConfigError(
            "--slurm needs submitit, which is not installed: pip install 'pimper_torch[slurm]'."
        )
    if cluster == "slurm" and shutil.which("sbatch") is None:
        raise ConfigError(
            "--slurm needs Slurm's commands, and there is no `sbatch` here. Run it where jobs are "
            "submitted, as on a login node."
        )
