"""Which code finds a record: a hash of the files it imports, and versions."""

import hashlib
import re
from collections.abc import Iterator
from functools import cache
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

_PACKAGE = Path(__file__).parents[1]
_IMPORT = re.compile(
    rb"^[ \t]*(?:from (pimper_torch[\w.]*) import (\([^)]*\)|.*)|import (pimper_torch[\w.]*))",
    re.MULTILINE,
)


@cache
def code_of(module: str) -> str | None:
    """Hash the code that a module of this package runs, and the versions of what it runs on.

    Args:
        module: Such as ``pimper_torch.fusion.fuse``.

    Returns:
        Hexadecimal; ``None`` for a module outside this package, whose code is not known.
    """
    (file, *_) = [*_files(module), None]
    if file is None:
        return None
    found, waiting = {file}, [file]
    while waiting:
        new = _imported(waiting.pop()) - found
        found |= new
        waiting += new
    hashed = hashlib.blake2b(_versions().encode(), digest_size=16)
    for path in sorted(found):
        hashed.update(path.read_bytes())
    return hashed.hexdigest()


@cache
def _imported(file: Path) -> frozenset[Path]:
    """Return the files of this package that a file imports, inside functions too."""
    modules = []
    for source, names, whole in _IMPORT.findall(file.read_bytes()):
        module = (source or whole).decode()
        modules += [module, *(f"{module}.{name.decode()}" for name in re.findall(rb"\w+", names))]
    return frozenset(found for module in modules for found in _files(module))


def _files(module: str) -> Iterator[Path]:
    """Return a module's file, if it is one of this package."""
    first, *parts = module.split(".")
    path = _PACKAGE.joinpath(*parts)
    if first == _PACKAGE.name and parts:
        choices = (path.with_suffix(".py"), path / "__init__.py")
        yield from (choice for choice in choices if choice.exists())


@cache
def _versions() -> str:
    """Name what this package depends on and the versions that are installed."""
    try:
        needed = requires(_PACKAGE.name) or []
    except PackageNotFoundError:
        needed = ["torch", "numpy", "numba", "pycolmap"]
    names = {re.split(r"[^\w.-]", one)[0] for one in needed if "extra ==" not in one}
    return " ".join(f"{name} {_version(name)}" for name in sorted(names))


def _version(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "not installed"
