"""Which version this is, and of what it is built on."""

import platform
from importlib.metadata import PackageNotFoundError, version

_TOLD = ("pimper_torch", "torch", "kornia", "pycolmap")


def installed_version(distribution: str = "pimper_torch") -> str:
    """Name the version of an installed distribution."""
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "not installed"


def versions() -> dict[str, str]:
    """Return the versions that a report of a fault needs, without loading what they are of."""
    return {
        **{name: installed_version(name) for name in _TOLD},
        "Python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
    }
