"""Versions of this package and its dependencies."""

import platform
from importlib.metadata import PackageNotFoundError, version

_REPORTED = ("pimper_torch", "torch", "kornia", "pycolmap")


def installed_version(distribution: str = "pimper_torch") -> str:
    """Return the version of an installed distribution."""
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "not installed"


def versions() -> dict[str, str]:
    """Return the versions for a bug report, without importing the packages."""
    return {
        **{name: installed_version(name) for name in _REPORTED},
        "Python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
    }
