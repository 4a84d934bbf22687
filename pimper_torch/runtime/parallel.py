"""Work on batches side by side, in threads, with results in the order of the batches.

Operations on a batch that fits the cache gain nothing from a second thread inside them; two batches
on two cores gain a factor of two. So every worker has one thread inside torch. A result depends on
its batch alone: neither the number of workers nor who is first changes it.
"""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from contextvars import copy_context
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import TypeVar

import torch

from pimper_torch.runtime.journal import current, writing
from pimper_torch.runtime.ledger import added_up
from pimper_torch.runtime.mapped import drop_pages
from pimper_torch.runtime.progress import listening, report

Item = TypeVar("Item")
Result = TypeVar("Result")


def num_workers() -> int:
    """Return how many batches are worked on side by side: as many as torch has threads."""
    return 1 if current().worker else torch.get_num_threads()


def side_by_side(
    work: Callable[[Item], Result], items: Sequence[Item], tracked: bool = True
) -> Iterator[Result]:
    """Apply ``work`` to every item, a few at a time, and yield the results in order.

    Not more results than workers wait to be taken, so that memory stays bounded. Context variables
    and whether gradients are recorded are those of the caller.

    Args:
        work: Called in a worker thread.
        tracked: Whether progress is reported after every result.

    Raises:
        BaseException: What ``work`` raised for the first item, in order, that failed.
    """
    workers = min(num_workers(), len(items))
    results = _in_threads(work, items, workers) if workers > 1 else _one_by_one(work, items)
    with nullcontext() if current().worker else added_up():
        for done, result in enumerate(results, start=1):
            yield result
            drop_pages()
            if tracked:
                report(done, len(items))


def over_rows(
    kernel: Callable[..., Result], rows: int, *arguments: object, size: int = 1
) -> list[Result]:
    """Call ``kernel(*arguments, first, last)`` on ranges that make up all rows, side by side.

    Args:
        kernel: Compiled, so that it holds no lock; what it does for a row depends on no other.
        size: How many rows of usual work one of them is.
    """
    # Fewer rows take a second thread some 50 microseconds, which it is not worth.
    workers = num_workers() if rows * size >= 20_000 else 1
    bounds = [rows * part // workers for part in range(workers + 1)]
    others = [
        _idle(workers - 1).submit(kernel, *arguments, first, last)
        for first, last in pairwise(bounds[1:])
    ]
    return [kernel(*arguments, *bounds[:2]), *(other.result() for other in others)]


@cache
def _idle(workers: int) -> ThreadPoolExecutor:
    """Return threads that wait for work as long as the process lives."""
    return ThreadPoolExecutor(workers, thread_name_prefix="rows")


def _one_by_one(work: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[Result]:
    for item in items:
        with listening(None), _threads(1):
            result = work(item)
        yield result


def _in_threads(
    work: Callable[[Item], Result], items: Sequence[Item], workers: int
) -> Iterator[Result]:
    grad = torch.is_grad_enabled()

    def one(item: Item) -> Result:
        alone = replace(current(), worker=True, progress=None)
        with torch.set_grad_enabled(grad), writing(alone):
            return work(item)

    waiting: deque[Future[Result]] = deque()
    pool = ThreadPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,))
    # A worker's setting reaches other threads of the process too: theirs is put back.
    with _threads(torch.get_num_threads()), ExitStack() as leaving:
        # Nothing more starts once the block is left, and what runs is waited for.
        leaving.callback(pool.shutdown, cancel_futures=True)
        for item in items:
            if len(waiting) > workers:
                yield waiting.popleft().result()
            waiting.append(pool.submit(copy_context().run, one, item))
        while waiting:
            yield waiting.popleft().result()


def on_one_thread() -> AbstractContextManager[None]:
    """Let torch and LAPACK use one thread, so that bits do not depend on how many there are."""
    return _threads(1)


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """Set torch's threads on entry; on exit they are what they were."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
