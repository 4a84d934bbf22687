"""Formats that need a package more than the others, which may be absent; HEIC, by libheif."""

import re
from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from PIL import ExifTags, Image

from pimper_torch.doors.io.header import Header, focal_from_exif
from pimper_torch.doors.io.profiles import colour_of_codes, colour_of_exif, read_profile
from pimper_torch.ground.radiometry.colour import SILENT, Colour
from pimper_torch.runtime.errors import InputError

HEIC_SUFFIXES = (".heic", ".heif", ".hif")
RAW_SUFFIXES = (
    *(".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".sr2", ".raf", ".orf", ".rw2"),
    *(".pef", ".srw", ".3fr", ".iiq", ".rwl"),
)
# Of each extra: its name for people, and the modules any of which will do.
_EXTRAS = {"heic": ("a HEIC image", ("pi_heif", "pillow_heif")), "raw": ("camera raw", ("rawpy",))}
# How files begin. Most camera raw begins as TIFF does.
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
    """Return the name of a file's format by its first bytes; empty where they tell none."""
    try:
        with Path(path).open("rb") as file:
            start = file.read(16)
    except OSError:
        return ""
    return next((name for name, mark in _STARTS.items() if re.match(mark, start, re.DOTALL)), "")


def extra_of(path: Path | str) -> str:
    """Return the extra that reads a file, ``heic`` or ``raw``; empty where none is needed.

    The content tells, not the suffix, unless it is a TIFF's or tells nothing.
    """
    name, suffix = format_of(path), Path(path).suffix.lower()
    if name == "CR3" or (suffix in RAW_SUFFIXES and name in ("TIFF", "")):
        return "raw"
    return "heic" if name == "HEIC" or (suffix in HEIC_SUFFIXES and not name) else ""


def is_installed(extra: str) -> bool:
    """Return whether a package of an extra is installed."""
    return any(_is_there(name) for name in _EXTRAS[extra][1])


def load_extra(extra: str, path: Path | str) -> ModuleType:
    """Import the package of an extra."""
    kind, modules = _EXTRAS[extra]
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


def read_heic_header(path: Path | str) -> Header:
    """Read what the primary picture of a HEIC file is, without its pixels.

    The file's own rotation is applied; EXIF's, which only repeats it, is not.
    """
    opened = _opened(path)
    image = opened[opened.primary_index]
    info: Mapping[str, Any] = image.info
    exif = Image.Exif()
    if isinstance(info.get("exif"), bytes):
        exif.load(info["exif"])
    colour = _colour(info)
    bits = int(info.get("bit_depth", 8))
    return Header(
        width=image.size[0],
        height=image.size[1],
        orientation=1,
        focal_px=focal_from_exif(exif.get_ifd(ExifTags.IFD.Exif), *image.size),
        channels=3 if image.mode.startswith("RGB") else 1,
        deep=bits > 8,
        full=255 if bits <= 8 else (2**bits - 1) << (16 - bits),
        colour=colour_of_exif(exif) if colour is SILENT else colour,
    )


def read_heic(path: Path | str) -> np.ndarray:
    """Decode the primary picture at its full depth, ``height width channel``; opacity last."""
    opened = _opened(path)
    image = opened[opened.primary_index]
    if image.mode.partition(";")[0] in ("RGBa", "La"):
        raise InputError(
            f"{path}: has colours multiplied by their opacity; needed: a photograph without "
            "transparency. Save it as PNG."
        )
    # A copy, made while the file that owns the memory is alive.
    return np.array(image, copy=True)


def _opened(path: Path | str) -> Any:  # noqa: ANN401 - of a package that may be absent
    heif = load_extra("heic", path)
    return heif.open_heif(Path(path).read_bytes(), convert_hdr_to_8bit=False, bgr_mode=False)


def _colour(info: Mapping[str, Any]) -> Colour:
    profile, codes = info.get("icc_profile"), info.get("nclx_profile")
    if isinstance(profile, bytes) and profile:
        return read_profile(profile)
    if not isinstance(codes, Mapping):
        return SILENT
    # Its matrix and range are undone by the decoder.
    primaries, curve = codes["color_primaries"], codes["transfer_characteristics"]
    return colour_of_codes(int(primaries), int(curve), "HEIC's nclx")
