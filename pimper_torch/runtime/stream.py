"""The stream of events of a call, shared by its threads. Results do not depend on it.

An event passes from the innermost listener outwards, until one of them keeps it.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from pimper_torch.runtime.events import AnyEvent, Caution, Event

Emit = Callable[[Event], bool]
Listener = Callable[[Event, Emit], bool]
"""Receives an event, and the function that passes one on to the listeners outside.

Returns whether the event was heard, here or outside.
"""


def _unheard(_: Event) -> bool:
    return False


_emit: ContextVar[Emit] = ContextVar("emit", default=_unheard)


def emit(event: Event) -> bool:
    """Pass an event to the listeners of the current call, and return whether one heard it."""
    return _emit.get()(event)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Pass the events of the ``with`` block, including its threads, to a listener."""
    outside = _emit.get()
    token = _emit.set(lambda event: listener(event, outside))
    try:
        yield
    finally:
        _emit.reset(token)


@contextmanager
def collected(
    *kinds: type[AnyEvent], into: list[AnyEvent] | None = None, passed_on: bool = False
) -> Iterator[list[AnyEvent]]:
    """Collect the events of some kinds in the ``with`` block.

    Args:
        into: Earlier events, to which new ones are appended.
        passed_on: Whether listeners outside receive the events, too. Those that none of them hears
            are then not collected, except cautions, which Python shows.
    """
    events: list[AnyEvent] = [] if into is None else into

    def collect(event: Event, outside: Emit) -> bool:
        if not isinstance(event, kinds):
            return outside(event)
        heard = not passed_on or outside(event)
        if heard or isinstance(event, Caution):
            events.append(event)
        return heard

    with listening(collect):
        yield events
