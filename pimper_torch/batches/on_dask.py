"""Workers of ``dask.distributed``, an extra: its only importer."""

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from importlib.util import find_spec
from typing import TYPE_CHECKING

from pimper_torch.batches.task import Outcome, Task
from pimper_torch.errors import ConfigError, caution

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
