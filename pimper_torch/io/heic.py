"""HEIC images, decoded by libheif."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image

from pimper_torch.io.extras import load_extra
from pimper_torch.io.header import Header, focal_from_exif
from pimper_torch.io.profiles import colour_of_codes, colour_of_exif, colour_of_info
from pimper_torch.io.tiff import PREMULTIPLIED
from pimper_torch.radiometry.colour import SILENT
from pimper_torch.runtime.errors import InputError


def read_heic_header(path: Path | str) -> Header:
    """Read size, colours and EXIF of the primary image of a HEIC file, without its pixels.

    The rotation of the HEIC container is applied; EXIF's, which repeats it, is not.
    """
    opened = _opened(path)
    image = opened[opened.primary_index]
    info: Mapping[str, Any] = image.info
    exif = Image.Exif()
    if isinstance(info.get("exif"), bytes):
        exif.load(info["exif"])
    colour, codes = SILENT, info.get("nclx_profile")
    if info.get("icc_profile"):
        colour = colour_of_info(info)
    elif isinstance(codes, Mapping):  # the decoder already applies matrix and range
        primaries, curve = codes["color_primaries"], codes["transfer_characteristics"]
        colour = colour_of_codes(int(primaries), int(curve), "HEIC's nclx")
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
    """Decode the primary image at full bit depth, ``height width channel`` with opacity last."""
    opened = _opened(path)
    image = opened[opened.primary_index]
    if image.mode.partition(";")[0] in ("RGBa", "La"):
        raise InputError(f"{path}: {PREMULTIPLIED}")
    # A copy, as the memory belongs to the file.
    return np.array(image, copy=True)


def _opened(path: Path | str) -> Any:  # noqa: ANN401 - of a package that may be absent
    heif = load_extra("heic", path)
    return heif.open_heif(Path(path).read_bytes(), convert_hdr_to_8bit=False, bgr_mode=False)
