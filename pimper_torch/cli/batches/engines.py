"""Executors of a batch: workers of ``dask.distributed``, and Slurm jobs by ``submitit``."""

import math
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from pimper_torch.cli.batches.task import Outcome, Task, attempted
from pimper_torch.runtime.errors import ConfigError, caution

_TIMEOUT_SECONDS = 10  # chosen by hand
_MISSING = "{} needs {}, which is not installed. Run pip install 'pimper_torch[{}]'."


@contextmanager
def dask_workers(address: str) -> Iterator[Executor]:
    """Connect to a scheduler, which reschedules the tasks of dead workers, inside the block.

    Raises:
        ConfigError: ``distributed`` is not installed, or no scheduler answers.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise ConfigError(_MISSING.format("--dask", "dask.distributed", "dask")) from error
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
        yield client.get_executor(pure=False)


class SlurmExecutor(ThreadPoolExecutor):
    """Executor with a Slurm job per task, which requests the task's time, memory and threads.

    Args:
        folder: Folder of submitit for tasks, outcomes and logs, visible to every node.
        jobs: Number of simultaneous jobs; a thread waits for each.
        partition: Partition of Slurm; empty for Slurm's default.
    """

    def __init__(self, folder: Path | str, jobs: int, partition: str = "") -> None:
        try:
            from submitit import AutoExecutor
        except ImportError as error:
            raise ConfigError(_MISSING.format("--slurm", "submitit", "slurm")) from error
        if shutil.which("sbatch") is None:
            raise ConfigError(
                "--slurm needs Slurm's commands, but `sbatch` is not found. Run it where jobs are "
                "submitted, such as on a login node."
            )
        super().__init__(jobs)
        self._executor = AutoExecutor(folder=folder, cluster="slurm")
        self._partition = partition
        # Submitit has one set of parameters, and queries the states of all jobs together.
        self._lock = threading.Lock()

    def submit(  # type: ignore[override]
        self, work: Callable[[Task, Callable[[Task], Outcome]], Outcome], task: Task
    ) -> Future[Outcome]:
        """Submit a job for each try; it is cancelled if the batch is interrupted."""
        return super().submit(work, task, self._in_job)

    def _in_job(self, task: Task) -> Outcome:
        with self._lock:
            self._executor.update_parameters(
                name="pimper",
                # The worker itself ends a try at its limit.
                timeout_min=math.ceil(task.limit_s / 60) + 5,
                mem_gb=math.ceil(task.mem_gb),
                cpus_per_task=task.threads,
                slurm_partition=self._partition or None,
            )
            job = self._executor.submit(attempted, task)
        while not task.stopped:
            with self._lock:
                if job.done():
                    return job.result()
            time.sleep(1.0)
        job.cancel(check=False)
        raise CancelledError
