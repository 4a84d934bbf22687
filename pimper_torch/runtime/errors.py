"""Errors and warnings of the package.

Every message gives the location, the value, the requirement, and advice.
"""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Literal

from pimper_torch.runtime.journal import current, writing

OnFailure = Literal["skip", "fail"]
"""Whether a failed patch, view or solver is skipped, or ends the run."""


class PimperError(Exception):
    """Base of all errors that this package raises on purpose."""


class InputError(PimperError):
    """Unusable photographs, masks, models or meshes."""


class ConfigError(PimperError):
    """Unknown setting, or impossible value of a setting."""


class OutputError(PimperError):
    """Results cannot be written to the requested location."""


class ReconstructionError(PimperError):
    """Structure from motion, or a later stage, has too little data to continue."""


class OutOfMemoryError(ReconstructionError):
    """Memory ran out."""


class NumericalError(PimperError):
    """Equations that are singular or contradictory."""


class PimperWarning(UserWarning):
    """Warning about a result that is returned anyway."""


def caution(message: str, stacklevel: int = 1) -> None:
    """Warn immediately or, inside :func:`held`, record the message for the owner of the block.

    Args:
        stacklevel: As for :func:`warnings.warn`, counted from the caller.
    """
    journal = current()
    journal.note(message)
    if not journal.quiet:
        warnings.warn(message, PimperWarning, stacklevel=stacklevel + 1)


def cautioned() -> list[str]:
    """Return the messages of :func:`caution` so far in this call."""
    return [event for event in current().so_far() if isinstance(event, str)]


@contextmanager
def held() -> Iterator[list[str]]:
    """Hold back the cautions of the ``with`` block.

    If the block raises an error, the warnings are given first.

    Yields:
        A list, filled with the messages at the end of the block.
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
    """Return the first names of a list for a message, and the number of others.

    >>> some(["a", "b", "c"], most=2)
    'a, b and 1 more'
    """
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")


def shortened(text: str, most: int = 200) -> str:
    """Return a text, cut to at most ``most`` characters."""
    return text if len(text) <= most else f"{text[: most - 3]}..."
