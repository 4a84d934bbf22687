"""Colour metadata of image files: ICC profiles, Pillow's metadata, codes, and EXIF.

Source for profiles, which are untrusted: ICC.1:2022, sections 7 (header, table of tags) and 10
(``curv``, ``para``, ``XYZ``, ``desc`` and ``mluc``). Profiles with tone curves and primaries are
supported; tables of colours (``A2B0``), PNG's gAMA and cHRM and EXIF's gamma are not.
"""

import struct
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import torch
from jaxtyping import Float
from PIL import ExifTags, Image
from torch import Tensor

from pimper_torch.io.header import positive_number
from pimper_torch.radiometry import Curve, Gamma, Linear, Response, Srgb
from pimper_torch.radiometry.colour import SILENT, Colour, plain
from pimper_torch.radiometry.primaries import (
    ADOBE_RGB,
    DISPLAY_P3,
    REC_709,
    REC_2020,
    Chromaticities,
    primaries_of,
    srgb_from_primaries,
)
from pimper_torch.runtime.errors import InputError

# Choices: profiles of printers have 2 MB and about 20 tags.
_MAX_BYTES, _MAX_TAGS = 2**22, 100
_HEADER, _ENTRY = 128, 12
# At which formulas are sampled.
_LEVELS = torch.linspace(0, 1, 4097, dtype=torch.float64, device="cpu")
# Number of parameters of each function of a `para` curve.
_PARAMETERS = (1, 3, 4, 5, 7)
# Choices: largest fall of a curve, as rounding makes two pieces meet inexactly; least rise of a
# photograph's curve over all levels.
_MAX_FALL, _MIN_RISE = 1e-3, 0.5


@lru_cache(maxsize=8)
def read_profile(data: bytes) -> Colour:
    """Return the response and primaries of an ICC profile.

    Never raises an error: unsupported content is named in :attr:`Colour.trouble`.
    """
    source = "an ICC profile"
    try:
        tags = _tags(data)
        source = f'the ICC profile "{_name(tags)}"' if _name(tags) else source
        kind, space, connection = data[12:16], data[16:20], data[20:24]
        if kind not in (b"scnr", b"mntr", b"prtr", b"spac"):
            raise InputError("is not a profile of photographs")
        if space not in (b"RGB ", b"GRAY"):
            raise InputError(f"is for {_printable(space.decode('latin-1'))}, not RGB or gray")
        names = (b"kTRC",) if space == b"GRAY" else (b"rTRC", b"gTRC", b"bTRC")
        if any(name not in tags for name in names):
            raise InputError("is a table of colours without tone curves")
        if connection != b"XYZ ":
            raise InputError("has tone curves in CIELab")
        response = plain(_joined([tags[name] for name in names]))
        if space == b"GRAY":
            return Colour(source=source, response=response)
        columns = [tags.get(name, b"") for name in (b"rXYZ", b"gXYZ", b"bXYZ")]
        if any(len(column) < 20 or column[:4] != b"XYZ " for column in columns):
            return Colour(source=source, response=response, trouble="has no primaries")
        values = [struct.unpack_from(">3i", column, 8) for column in columns]
        return _colour(source, response, torch.tensor(values, dtype=torch.float64).T / 65536)
    except (InputError, struct.error, ValueError) as error:
        trouble = str(error) if isinstance(error, InputError) else "is damaged"
        return Colour(source=source, trouble=trouble)


def _colour(source: str, response: Response | None, primaries: Tensor | None) -> Colour:
    """Combine a response and primaries: columns of XYZ adapted to D50, or ``None``."""
    matrix = None if primaries is None else srgb_from_primaries(primaries)
    if matrix is None:
        trouble = "has primaries that are linearly dependent"
        return Colour(source=source, response=response, trouble=trouble)
    same = torch.equal(matrix, torch.eye(3).double())
    return Colour(source=source, response=response, srgb_from_file=None if same else matrix)


def _tags(data: bytes) -> dict[bytes, bytes]:
    """Return the contents of the tags with offsets inside the profile."""
    if not _HEADER + 4 <= len(data) <= _MAX_BYTES or data[36:40] != b"acsp":
        raise InputError("is damaged")
    (count,) = struct.unpack_from(">I", data, _HEADER)
    if count > _MAX_TAGS or _HEADER + 4 + _ENTRY * count > len(data):
        raise InputError("is damaged")
    tags = {}
    for index in range(count):
        name, offset, size = struct.unpack_from(">4sII", data, _HEADER + 4 + _ENTRY * index)
        if offset + size <= len(data):
            tags[name] = data[offset : offset + size]
    return tags


def _name(tags: dict[bytes, bytes]) -> str:
    tag = tags.get(b"desc", b"")
    if tag[:4] == b"desc" and len(tag) >= 12:
        (length,) = struct.unpack_from(">I", tag, 8)
        return _printable(tag[12 : 12 + min(length, 60)].decode("ascii", "ignore"))
    if tag[:4] == b"mluc" and len(tag) >= 28:
        length, offset = struct.unpack_from(">II", tag, 20)
        return _printable(tag[offset : offset + min(length, 120)].decode("utf-16-be", "ignore"))
    return ""


def _printable(text: str) -> str:
    return "".join(char for char in text if char.isprintable() and char != '"').strip()


def _curve(tag: bytes) -> Response:
    if tag[:4] == b"para":
        return _function(tag)
    if tag[:4] != b"curv":
        raise InputError("has tone curves of an unknown type")
    (count,) = struct.unpack_from(">I", tag, 8)
    if count > 65536 or 12 + 2 * count > len(tag):
        raise InputError("has a tone curve that is cut short")
    values = struct.unpack_from(f">{count}H", tag, 12)
    if count < 2:
        return _power(values[0] / 256 if values else 1.0)
    return _table(torch.tensor(values, dtype=torch.float64) / 65535)


def _function(tag: bytes) -> Response:
    (kind,) = struct.unpack_from(">H", tag, 8)
    if kind >= len(_PARAMETERS):
        raise InputError("has a tone curve of an unknown function")
    values = struct.unpack_from(f">{_PARAMETERS[kind]}i", tag, 12)
    g, a, b, c, d, e, f = (*(value / 65536 for value in values), *(0.0,) * 7)[:7]
    if kind == 0:
        return _power(g)
    if a == 0:
        raise InputError("has a tone curve that is flat")
    lifted = (a * _LEVELS + b).clamp_min(0) ** g
    if kind in (1, 2):
        return _table(torch.where(a * _LEVELS + b >= 0, lifted, 0.0) + c)
    return _table(torch.where(d <= _LEVELS, lifted + e, c * _LEVELS + f))


def _power(exponent: float) -> Response:
    if not 0.1 <= exponent <= 10:
        raise InputError(f"has a gamma of {exponent:.4g}")
    return Linear() if exponent == 1 else Gamma(exponent=exponent)


def _table(radiance: Float[Tensor, " entry"]) -> Curve:
    """Return the response with this radiance at levels evenly spaced from 0 to 1."""
    highest = radiance.clamp_min(0).cummax(dim=0).values
    monotonic = bool(radiance.isfinite().all()) and float((highest - radiance).max()) < _MAX_FALL
    if not monotonic or float(highest[-1] - highest[0]) < _MIN_RISE:
        raise InputError("has a tone curve that does not rise")
    level = torch.linspace(0, 1, len(radiance), dtype=torch.float64)
    rising = highest + 1e-6 * level  # strictly, also where levels have equal radiance
    return Curve(encoded=level, radiance=(rising / rising[-1])[None])


def _joined(tags: Sequence[bytes]) -> Response:
    """Return the tone curve of all colours, which is usually shared, else one per colour."""
    if len({*tags}) == 1:
        return _curve(tags[0])
    curves = [_curve(tag) for tag in tags]
    tables = [curve for curve in curves if isinstance(curve, Curve)]
    if len(tables) == len(curves) and len({len(table.encoded) for table in tables}) == 1:
        rows = torch.cat([table.radiance for table in tables])
        return Curve(encoded=tables[0].encoded, radiance=rows)
    rows = torch.stack([curve.linear_from_encoded(_LEVELS) for curve in curves])
    return Curve(encoded=_LEVELS, radiance=rows)


# Codes of ITU-T H.273, in PNG's cICP and HEIC.
_PRIMARIES: Mapping[int, Chromaticities] = {1: REC_709, 9: REC_2020, 12: DISPLAY_P3}
_REC_709_CURVE = (1, 6, 14, 15)


def colour_of_codes(primaries: int, curve: int, source: str) -> Colour:
    """Return the colour of the codes of ITU-T H.273 for primaries and transfer.

    Args:
        primaries: 1 sRGB's, 9 BT.2020, 12 Display P3; 2 if not stated.
        curve: 13 sRGB, 8 linear, 1, 6, 14 and 15 BT.709; 2 if not stated.
    """
    response: Response | None
    if curve in _REC_709_CURVE:
        curved = ((_LEVELS + 0.099) / 1.099) ** (1 / 0.45)
        response = _table(torch.where(_LEVELS < 0.081, _LEVELS / 4.5, curved))
    elif curve in (2, 8, 13):
        response = {2: None, 8: Linear(), 13: Srgb()}[curve]
    else:
        return Colour(source=source, trouble=f"names transfer {curve}, as of HDR or film")
    if primaries == 2:
        return Colour(source=source, response=response)
    if primaries not in _PRIMARIES:
        return Colour(source=source, response=response, trouble=f"names primaries {primaries}")
    return _colour(source, response, primaries_of(_PRIMARIES[primaries]))


# Chromaticities of sRGB in PNG's order: white, red, green and blue.
_SRGB_XY = tuple(value for point in (REC_709[3], *REC_709[:3]) for value in point)
# Choices: programs round PNG's 0.45455 and EXIF's 2.2, which mean sRGB, and chromaticities.
_SRGB_GAMMA, _NEAR, _NEAR_XY = 2.2, 0.02, 0.005


def colour_of_info(info: Mapping[Any, Any], cicp: bytes = b"") -> Colour:
    """Return the colour of PNG's cICP, else of a profile, PNG's sRGB, or gAMA with cHRM.

    Args:
        info: Pillow's ``info`` of an opened file.
        cicp: Content of PNG's chunk, which Pillow does not read.
    """
    if cicp:
        primaries, curve, matrix, full = cicp if len(cicp) == 4 else (0, 0, 0, 0)
        if (matrix, full) != (0, 1):
            return Colour(source="PNG's cICP", trouble="is not for full-range RGB")
        return colour_of_codes(primaries, curve, "PNG's cICP")
    if "icc_profile" in info:
        profile = info["icc_profile"]
        return read_profile(profile if isinstance(profile, bytes) else b"")
    if "srgb" in info:
        return Colour(source="PNG's sRGB", response=Srgb())
    gamma, points = info.get("gamma", 1 / _SRGB_GAMMA), info.get("chromaticity", _SRGB_XY)
    distance = max(abs(xy - srgb) for xy, srgb in zip(points, _SRGB_XY, strict=True))
    exponent = 1 / gamma if gamma else 0.0
    if abs(exponent - _SRGB_GAMMA) >= _NEAR or distance > _NEAR_XY:
        return Colour(source="PNG", trouble=f"has gAMA {gamma:.5g} and cHRM that are not sRGB's")
    return Colour(source="PNG's gAMA", response=Srgb()) if "gamma" in info else SILENT


def colour_of_exif(exif: Image.Exif) -> Colour:
    """Return Adobe RGB if EXIF marks it, as cameras do without a profile; gamma is unsupported."""
    tags = exif.get_ifd(ExifTags.IFD.Exif)
    gamma = tags.get(ExifTags.Base.Gamma)
    if gamma is not None and abs(positive_number(gamma) - _SRGB_GAMMA) >= _NEAR:
        return Colour(source="EXIF", trouble="has a gamma that is not sRGB's")
    marked = tags.get(ExifTags.Base.ColorSpace) == 65535 and ExifTags.IFD.Interop in tags
    index = exif.get_ifd(ExifTags.IFD.Interop).get(ExifTags.Interop.InteropIndex) if marked else ""
    if str(index).strip("\0 ") == "R03":  # Adobe RGB by DCF 2.0
        return _colour("EXIF (Adobe RGB)", Gamma(exponent=563 / 256), primaries_of(ADOBE_RGB))
    return SILENT
