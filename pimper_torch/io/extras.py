"""Formats of photographs, and optional packages that some of them need."""

import re
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

from pimper_torch.runtime.errors import InputError

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
HEIC_SUFFIXES = (".heic", ".heif", ".hif")
RAW_SUFFIXES = (
    *(".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".sr2", ".raf", ".orf", ".rw2"),
    *(".pef", ".srw", ".3fr", ".iiq", ".rwl"),
)
# Name of each extra in messages, and the modules that provide it.
_EXTRAS = {"heic": ("a HEIC image", ("pi_heif", "pillow_heif")), "raw": ("camera raw", ("rawpy",))}
# First bytes of files. Most camera raw begins like TIFF.
_STARTS = {
    "JPEG": rb"\xff\xd8\xff",
    "PNG": rb"\x89PNG",
    "TIFF": rb"II[*+]\0|MM\0[*+]",
    "HEIC": rb".{4}ftyp(he|mif1|msf1)",
    "CR3": rb".{4}ftypcrx",
    "AVIF": rb".{4}ftypavi",
    "MP4": rb".{4}ftyp",
    "GIF": rb"GIF8",
    "WebP": rb"RIFF.{4}WEBP",
    "PSD": rb"8BPS",
    "PDF": rb"%PDF",
}


def format_of(path: Path | str) -> str:
    """Return the name of a file's format by its first bytes; empty if unknown."""
    try:
        with Path(path).open("rb") as file:
            start = file.read(16)
    except OSError:
        return ""
    return next((name for name, mark in _STARTS.items() if re.match(mark, start, re.DOTALL)), "")


def extra_of(path: Path | str) -> str:
    """Return the extra that reads a file, ``heic`` or ``raw``; empty if none is needed.

    The content decides; the suffix only if the content is TIFF or unknown.
    """
    name, suffix = format_of(path), Path(path).suffix.lower()
    if name == "CR3" or (suffix in RAW_SUFFIXES and name in ("TIFF", "")):
        return "raw"
    return "heic" if name == "HEIC" or (suffix in HEIC_SUFFIXES and not name) else ""


def is_installed(extra: str) -> bool:
    """Return whether a package of an extra is installed."""
    return any(_exists(name) for name in _EXTRAS[extra][1])


def load_extra(extra: str, path: Path | str) -> ModuleType:
    """Import the package of an extra; ``InputError`` about the file if it is missing."""
    kind, modules = _EXTRAS[extra]
    for name in modules:
        if _exists(name):
            return import_module(name)
    raise InputError(
        f"{path}: is {kind}, which needs an additional package: "
        f'`pip install "pimper_torch[{extra}]"`. Or convert it to 16-bit TIFF, PNG or JPEG.'
    )


def _exists(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ValueError:  # partially imported, or removed on purpose
        return False
