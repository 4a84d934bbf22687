"""Functions of later folders that methods of records are short for, such as ``mesh.save``."""

from collections.abc import Callable
from importlib import import_module
from typing import Any


def later(name: str) -> Callable[..., Any]:
    """Return a function by its module and name in the package, imported when it is called."""
    module, _, function = name.rpartition(".")
    found: Callable[..., Any] = getattr(import_module(f"pimper_torch.{module}"), function)
    return found
