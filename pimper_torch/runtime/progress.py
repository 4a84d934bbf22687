"""Progress of a stage, for display by the caller.

Stages iterate over batches with :func:`track`; a caller that displays a bar uses :func:`listening`.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from typing import TypeVar

from pimper_torch.runtime.journal import Journal, current, writing

Item = TypeVar("Item")
Listener = Callable[[int, int], None]


def report(done: int, total: int) -> None:
    """Inform the listener, if any, that ``done`` of ``total`` steps are finished."""
    listener = current().progress
    if listener is not None:
        listener(done, total)


def track(items: Sequence[Item]) -> Iterator[Item]:
    """Yield the items, and report progress after each."""
    for done, item in enumerate(items, start=1):
        yield item
        report(done, len(items))


def listening(listener: Listener | None) -> AbstractContextManager[Journal]:
    """Send reports of the ``with`` block to ``listener(done, total)``; ``None`` ignores them."""
    return writing(replace(current(), progress=listener))


@contextmanager
def part(place: int, count: int) -> Iterator[None]:
    """Report the progress of the ``with`` block as part ``place`` of ``count`` equal parts.

    Parts nest, so a stage of several steps with their own reports has one bar.
    """
    outer = current().progress

    def inside(done: int, total: int) -> None:
        if outer is not None:
            outer(place * total + done, count * total)

    with listening(inside):
        yield
    report(place + 1, count)
