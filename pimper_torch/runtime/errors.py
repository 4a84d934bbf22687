"""Errors of the package, in the caller's words.

Every message says where, what was found, what was needed, and what to do.
"""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Literal

from pimper_torch.runtime.journal import current, writing

OnFailure = Literal["skip", "fail"]
"""Whether a patch, view or solver that fails is left out, or ends the run."""


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
    """Memory that did not suffice."""


class NumericalError(PimperError):
    """Equations that the data leave open or contradict."""


class PimperWarning(UserWarning):
    """The result is delivered, but something about it should be known."""


def caution(message: str, stacklevel: int = 1) -> None:
    """Warn of something, at once or, inside :func:`held`, when the block's owner says so.

    Args:
        stacklevel: As of :func:`warnings.warn`, counted from the caller.
    """
    journal = current()
    journal.note(message)
    if not journal.quiet:
        warnings.warn(message, PimperWarning, stacklevel=stacklevel + 1)


def cautioned() -> list[str]:
    """Return what was cautioned of so far in this call."""
    return [event for event in current().so_far() if isinstance(event, str)]


@contextmanager
def held() -> Iterator[list[str]]:
    """Hold back what is cautioned of inside the ``with`` block.

    Where the block ends in an error, it is told before.

    Yields:
        The list that holds the messages when the block has ended.
    """
    messages, events = list[str](), current().so_far()
    before = len(events)
    try:
        with writing(replace(current(), events=events, quiet=True)):
            yield messages
    except BaseException:
        for message in [event for event in events[before:] if isinstance(event, str)]:
            caution(message)
        raise
    messages += [event for event in events[before:] if isinstance(event, str)]
    events[before:] = [event for event in events[before:] if not isinstance(event, str)]


def some(names: Sequence[str], most: int = 8) -> str:
    """List names for a message, the first few and how many more.

    >>> some(["a", "b", "c"], most=2)
    'a, b and 1 more'
    """
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")


def shortened(text: str, most: int = 200) -> str:
    """Cut a text that is longer."""
    return text if len(text) <= most else f"{text[: most - 3]}..."
