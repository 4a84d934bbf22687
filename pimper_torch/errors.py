"""Errors of the package, in the caller's words.

Every message says where, what was found, what was needed, and what to do.
"""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar


class PimperError(Exception):
    """Base of every error this package raises on purpose."""


class InputError(PimperError):
    """Photographs, masks, models or meshes that cannot be used as they are."""


class ConfigError(PimperError):
    """A setting that does not exist or has an impossible value."""


class OutputError(PimperError):
    """Results that cannot be written where they were asked for."""


class ReconstructionError(PimperError):
    """Structure from motion, or a stage after it, found too little to go on."""


class OutOfMemoryError(ReconstructionError):
    """Memory that did not suffice, for the smallest parts either."""


class NumericalError(PimperError):
    """Equations that the data leave open or contradict."""


class MissingProgramError(ReconstructionError):
    """A program that somebody else wrote is not installed here."""


class PimperWarning(UserWarning):
    """The result is delivered, but something about it should be known."""


_held: ContextVar[list[str] | None] = ContextVar("held", default=None)
_listeners: ContextVar[tuple[list[str], ...]] = ContextVar("listeners", default=())


def caution(message: str, stacklevel: int = 1) -> None:
    """Warn of something, at once or, inside :func:`held`, when the block's owner says so.

    Args:
        stacklevel: As of :func:`warnings.warn`, counted from the caller.
    """
    for listener in _listeners.get():
        listener.append(message)
    held_back = _held.get()
    if held_back is None:
        warnings.warn(message, PimperWarning, stacklevel=stacklevel + 1)
    else:
        held_back.append(message)


@contextmanager
def overheard() -> Iterator[list[str]]:
    """Note what is cautioned of inside the block, which is told all the same.

    Yields:
        The messages so far.
    """
    messages: list[str] = []
    token = _listeners.set((*_listeners.get(), messages))
    try:
        yield messages
    finally:
        _listeners.reset(token)


@contextmanager
def held() -> Iterator[list[str]]:
    """Hold back what is cautioned of in one round of many, as the last round's is enough.

    Where the block ends in an error, what was held back is told before it.

    Yields:
        The messages so far, for :func:`caution` after the last round.
    """
    messages: list[str] = []
    token = _held.set(messages)
    try:
        yield messages
    except BaseException:
        _held.reset(token)
        for message in messages:
            caution(message)
        raise
    _held.reset(token)


def some(names: Sequence[str], most: int = 8) -> str:
    """List names for a message, the first few and how many more.

    >>> some(["a", "b", "c"], most=2)
    'a, b and 1 more'
    """
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")
