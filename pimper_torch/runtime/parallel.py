"""Parallel work on batches, in threads, with results in the order of the batches.

A second thread inside an operation gains nothing if the batch fits the cache; two batches on two
cores gain a factor of two. Therefore every worker uses one thread inside torch. A result only
depends on its batch, not on the number or timing of workers.
"""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager
from contextvars import ContextVar, copy_context
from functools import cache
from itertools import pairwise
from typing import TypeVar

import torch

from pimper_torch.runtime.events import Event, Progress, Removal
from pimper_torch.runtime.ledger import left_out_of, sums_of
from pimper_torch.runtime.mapped import drop_pages
from pimper_torch.runtime.progress import report
from pimper_torch.runtime.stream import collected, emit

Item = TypeVar("Item")
Result = TypeVar("Result")

# Whether this thread is one of several, so that its calls must not start more.
_is_worker: ContextVar[bool] = ContextVar("is_worker", default=False)


def num_workers() -> int:
    """Return the number of batches processed in parallel: the number of torch's threads."""
    return 1 if _is_worker.get() else torch.get_num_threads()


def side_by_side(
    work: Callable[[Item], Result], items: Sequence[Item], tracked: bool = True
) -> Iterator[Result]:
    """Yield ``work(item)`` for every item in order, computed in parallel.

    To bound memory, one result per worker is buffered. Context and gradient mode are the caller's.

    Args:
        work: Called in a worker thread.
        tracked: Whether progress is reported after every result.

    Raises:
        BaseException: The error of the first item, in order, that failed.
    """
    events: list[Event] = []

    def apart(item: Item) -> Result:
        with collected(Removal, Progress, into=events):
            return work(item)

    workers = min(num_workers(), len(items))
    results = _in_threads(apart, items, workers) if workers > 1 else map(_threads(1)(apart), items)
    try:
        for done, result in enumerate(results, start=1):
            yield result
            drop_pages()
            if tracked:
                report(done, len(items))
    finally:
        for removal in sums_of(left_out_of(events)):
            emit(removal)


def over_rows(
    kernel: Callable[..., Result], rows: int, *arguments: object, size: int = 1
) -> list[Result]:
    """Return ``kernel(*arguments, first, last)`` of ranges that partition all rows, in parallel.

    Args:
        kernel: Compiled, so that it releases the lock; must process rows independently.
        size: Work per row, relative to usual rows.
    """
    # A second thread costs about 50 microseconds, too much for fewer rows.
    workers = num_workers() if rows * size >= 20_000 else 1
    bounds = [rows * index // workers for index in range(workers + 1)]
    others = [
        _idle(workers - 1).submit(kernel, *arguments, first, last)
        for first, last in pairwise(bounds[1:])
    ]
    return [kernel(*arguments, *bounds[:2]), *(other.result() for other in others)]


@cache
def _idle(workers: int) -> ThreadPoolExecutor:
    """Return a pool of threads that lives as long as the process."""
    return ThreadPoolExecutor(workers, thread_name_prefix="rows")


def _in_threads(
    work: Callable[[Item], Result], items: Sequence[Item], workers: int
) -> Iterator[Result]:
    grad, inference = torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    def in_worker(item: Item) -> Result:
        _is_worker.set(True)
        with torch.inference_mode(inference), torch.set_grad_enabled(grad):
            return work(item)

    waiting: deque[Future[Result]] = deque()
    pool = ThreadPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,))
    # A worker's setting affects all threads of the process: restore it at the end.
    with _threads(torch.get_num_threads()), ExitStack() as stack:
        # At the end of the block, cancel waiting items, and wait for running ones.
        stack.callback(pool.shutdown, cancel_futures=True)
        for item in items:
            if len(waiting) > workers:
                yield waiting.popleft().result()
            waiting.append(pool.submit(copy_context().run, in_worker, item))
        while waiting:
            yield waiting.popleft().result()


def on_one_thread() -> AbstractContextManager[None]:
    """Let torch and LAPACK use one thread, so that bits do not depend on the number of threads."""
    return _threads(1)


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """Set the number of torch's threads, and restore it at the end of the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
