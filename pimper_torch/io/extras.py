"""Formats that need a package more than the others, which may be absent."""

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

from pimper_torch.errors import InputError

HEIC_SUFFIXES = (".heic", ".heif", ".hif")
RAW_SUFFIXES = (
    *(".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".sr2", ".raf", ".orf", ".rw2"),
    *(".pef", ".srw", ".3fr", ".iiq", ".rwl"),
)
# Of each extra: its name for people, the suffixes, and the modules any of which will do.
_EXTRAS = {
    "heic": ("a HEIC image", HEIC_SUFFIXES, ("pi_heif", "pillow_heif")),
    "raw": ("camera raw", RAW_SUFFIXES, ("rawpy",)),
}


def is_heic(path: Path | str) -> bool:
    """Tell HEIC by its suffix."""
    return Path(path).suffix.lower() in HEIC_SUFFIXES


def is_raw(path: Path | str) -> bool:
    """Tell camera raw by its suffix."""
    return Path(path).suffix.lower() in RAW_SUFFIXES


def installed_suffixes() -> tuple[str, ...]:
    """Give the suffixes of formats whose package is there."""
    return tuple(
        suffix
        for _, suffixes, modules in _EXTRAS.values()
        for suffix in suffixes
        if any(_is_there(name) for name in modules)
    )


def load_extra(extra: str, path: Path | str) -> ModuleType:
    """Import the package of an extra.

    Raises:
        InputError: It is not installed; says how to.
    """
    kind, _, modules = _EXTRAS[extra]
    for name in modules:
        if _is_there(name):
            return import_module(name)
    raise InputError(
        f"{path}: is {kind}, which needs one more package: "
        f'`pip install "pimper_torch[{extra}]"`. Or convert it to TIFF of 16 bits, PNG or JPEG.'
    )


def _is_there(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ValueError:  # half imported, or taken away on purpose
        return False
