"""The code that found a record: the package's sources and its dependencies' versions."""

import hashlib
import re
from functools import cache
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

_PACKAGE = Path(__file__).parents[1]


@cache
def code() -> str:
    """Hash all source files of the package, and the versions of what it depends on."""
    hashed = hashlib.blake2b(_versions().encode(), digest_size=16)
    for path in sorted(_PACKAGE.rglob("*.py")):
        hashed.update(path.relative_to(_PACKAGE).as_posix().encode() + path.read_bytes())
    return hashed.hexdigest()


def is_known(module: str) -> bool:
    """Return whether :func:`code` covers a module: one of this package, or of torch's layers."""
    return module.startswith((f"{_PACKAGE.name}.", "torch.nn."))


def _versions() -> str:
    try:
        needed = requires(_PACKAGE.name) or []
    except PackageNotFoundError:  # sources that were not installed
        needed = ["torch", "numpy", "numba", "pycolmap"]
    names = {re.split(r"[^\w.-]", one)[0] for one in needed if "extra ==" not in one}
    return " ".join(f"{name} {version(name)}" for name in sorted(names))
