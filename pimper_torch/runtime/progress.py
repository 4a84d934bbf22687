"""Progress of a stage, for display by the caller: :class:`~pimper_torch.runtime.events.Progress`.

Stages iterate over batches with :func:`track`.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

from pimper_torch.runtime.events import Event, Progress
from pimper_torch.runtime.stream import Emit, emit, listening

Item = TypeVar("Item")


def report(done: int, total: int) -> None:
    """Inform listeners, if any, that ``done`` of ``total`` steps are finished."""
    emit(Progress(done=done, total=total))


def track(items: Sequence[Item]) -> Iterator[Item]:
    """Yield the items, and report progress after each."""
    for done, item in enumerate(items, start=1):
        yield item
        report(done, len(items))


@contextmanager
def part(place: int, count: int) -> Iterator[None]:
    """Report the progress of the ``with`` block as part ``place`` of ``count`` equal parts.

    Parts nest, so a stage of several steps with their own reports has one bar.
    """

    def within(event: Event, outside: Emit) -> bool:
        if isinstance(event, Progress):
            done, total = place * event.total + event.done, count * event.total
            event = Progress(done=done, total=total)
        return outside(event)

    with listening(within):
        yield
    report(place + 1, count)
