"""Errors and warnings of the package.

Every message gives the location, the value, the requirement, and advice.
"""

import sys
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Literal

from pimper_torch.runtime.events import Caution
from pimper_torch.runtime.stream import collected, emit

# Modules with the frames of :func:`~pimper_torch.runtime.torch_settings.isolated`.
_AROUND = ("contextlib", "pimper_torch.runtime.torch_settings", "torch._dynamo.eval_frame")

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
    """Warn immediately or, inside :func:`held`, leave that to the owner of the block.

    Args:
        stacklevel: As for :func:`warnings.warn`, counted from the caller; frames around a function
            of the package are left out.
    """
    if not emit(Caution(message=message)):
        stack = traceback.walk_stack(sys._getframe(1))
        names = enumerate((frame.f_globals.get("__name__") for frame, _ in stack), start=2)
        shown = [level for level, name in names if name not in _AROUND]
        warnings.warn(message, PimperWarning, stacklevel=shown[min(stacklevel, len(shown)) - 1])


@contextmanager
def held() -> Iterator[list[Caution]]:
    """Hold back and yield the cautions of the ``with`` block.

    If the block raises an error, the warnings are given first.
    """
    cautions: list[Caution] = []
    try:
        with collected(Caution, into=cautions):
            yield cautions
    except BaseException:
        for each in cautions:
            caution(each.message)
        raise


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
