"""Which version this is."""

from importlib.metadata import PackageNotFoundError, version


def installed_version() -> str:
    """Name the version of the installed package."""
    try:
        return version("pimper_torch")
    except PackageNotFoundError:
        return "not installed"
