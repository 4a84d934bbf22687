"""HEIC, as telephones and some cameras write it: read by libheif, turned by the file itself."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pimper_torch.errors import InputError
from pimper_torch.io.extras import load_extra
from pimper_torch.io.icc import read_profile
from pimper_torch.io.profiles import colour_of_codes
from pimper_torch.radiometry.colour import SILENT, Colour


@dataclass(frozen=True, slots=True, kw_only=True)
class HeicHead:
    """What a HEIC file says without decoding it.

    Attributes:
        width: Pixels, the right way up: the file's own rotation is applied, and EXIF's, which
            only repeats it, is not.
        height: Pixels.
        gray: One colour.
        full: Level of full scale, 255, or that of 10 or 12 bits filled up to 16.
        exif: As other files have it.
        colour: What it says about its samples.
    """

    width: int
    height: int
    gray: bool
    full: int
    exif: Image.Exif
    colour: Colour


def read_heic_head(path: Path | str) -> HeicHead:
    """Read what the primary picture of a HEIC file is, without its pixels."""
    opened = _opened(path)
    image = opened[opened.primary_index]
    info: Mapping[str, Any] = image.info
    exif = Image.Exif()
    if isinstance(info.get("exif"), bytes):
        exif.load(info["exif"])
    width, height = image.size
    bits = int(info.get("bit_depth", 8))
    return HeicHead(
        width=width,
        height=height,
        gray=not image.mode.startswith("RGB"),
        full=255 if bits <= 8 else (2**bits - 1) << (16 - bits),
        exif=exif,
        colour=_colour(info),
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
