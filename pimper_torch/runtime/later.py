"""Functions of later folders that methods of records are short for."""

from collections.abc import Callable
from importlib import import_module
from typing import Any


def later(name: str) -> Callable[..., Any]:
    """Return a function by its module and name within the package, imported when it is called.

    A folder imports only folders before it. Records and steps have a few methods for users, such
    as ``mesh.save``, whose functions are in later folders.
    """
    module, _, function = name.rpartition(".")
    found: Callable[..., Any] = getattr(import_module(f"pimper_torch.{module}"), function)
    return found
