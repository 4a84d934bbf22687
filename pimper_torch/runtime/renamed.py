"""Deprecated names, which work for one more version with a warning."""

import functools
import warnings
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any, TypeVar

T = TypeVar("T")


def renamed(old: str, new: str) -> str:
    """Warn that a name has changed, and return the new one."""
    warnings.warn(f"`{old}` is now `{new}`.", DeprecationWarning, stacklevel=3)
    return new


def renamed_names(module: str, names: Mapping[str, str]) -> Callable[[str], object]:
    """Return a module's ``__getattr__`` that finds renamed members by their former names."""

    def find(name: str) -> object:
        if name not in names:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        return getattr(import_module(module), renamed(name, names[name]))

    return find


def renamed_fields(**names: str) -> Callable[[type[T]], type[T]]:
    """Return a decorator for records that accepts former names of fields: ``former="new"``."""

    def wrap(record: type[T]) -> type[T]:
        init = record.__init__

        @functools.wraps(init)
        def make(self: T, **values: Any) -> None:  # noqa: ANN401 - the fields' own types
            for old in names.keys() & values:
                values[renamed(old, names[old])] = values.pop(old)
            init(self, **values)

        def reader(old: str, new: str) -> property:
            return property(lambda self: getattr(self, renamed(old, new)))

        setattr(record, "__init__", make)  # noqa: B010 - mypy forbids the plain assignment
        for old, new in names.items():
            setattr(record, old, reader(old, new))
        return record

    return wrap
