"""Progress of a stage, for whoever wants to show it.

Stages walk their batches through :func:`track`; nothing is printed. A caller that wants a
bar listens with :func:`listening`.
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
    """Walk through ``items``, reporting after each."""
    for done, item in enumerate(items, start=1):
        yield item
        report(done, len(items))


def listening(listener: Listener | None) -> AbstractContextManager[Journal]:
    """Send reports to ``listener(done, total)`` inside the ``with`` block, or to nobody."""
    return writing(replace(current(), progress=listener))


@contextmanager
def part(place: int, count: int) -> Iterator[None]:
    """Let what is reported inside the ``with`` block fill one of ``count`` equal parts.

    Parts nest, so that a stage of several steps, which report by themselves, has one bar.
    """
    whole = current().progress

    def inside(done: int, total: int) -> None:
        if whole is not None:
            whole(place * total + done, count * total)

    with listening(inside):
        yield
    report(place + 1, count)
