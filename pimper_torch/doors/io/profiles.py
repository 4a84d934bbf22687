"""Colour metadata of image files: ICC profiles, what Pillow found in a file, codes, and EXIF.

Source of the profiles, which anybody may have written: ICC.1:2022, sections 7 (header, table of
tags) and 10 (``curv``, ``para``, ``XYZ``, ``desc`` and ``mluc``). Followed are profiles of tone
curves and primaries; tables of colours (``A2B0``), PNG's gAMA and cHRM and EXIF's gamma are not.
"""

import struct
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import torch
from jaxtyping import Float
from PIL import ExifTags, Image
from torch import Tensor

from pimper_torch.doors.io.header import positive_number
from pimper_torch.ground.radiometry import Curve, Gamma, Linear, Response, Srgb
from pimper_torch.ground.radiometry.colour import SILENT, Colour, plain
from pimper_torch.ground.radiometry.primaries import (
    ADOBE_RGB,
    DISPLAY_P3,
    REC_709,
    REC_2020,
    Chromaticities,
    primaries_of,
    srgb_from_primaries,
)
from pimper_torch.runtime.errors import InputError

# Choices: printers' profiles have 2 MB, and some 20 tags.
_MAX_BYTES, _MAX_TAGS = 2**22, 100
_HEADER, _ENTRY = 128, 12
_LEVELS = torch.linspace(0, 1, 4097, dtype=torch.float64)  # of a curve that is a formula
# Number of parameters of each function of a `para` curve.
_PARAMETERS = (1, 3, 4, 5, 7)
# Choices: numbers of a profile are rounded, and two pieces of a curve meet up to that; one that
# rises by less over all levels is no photograph's.
_MAX_FALL, _MIN_RISE = 1e-3, 0.5


@lru_cache(maxsize=8)
def read_profile(data: bytes) -> Colour:
    """Read what an ICC profile says: the response, and the primaries.

    Never fails: what cannot be followed is named in :attr:`Colour.trouble`.
    """
    source = "an ICC profile"
    try:
        tags = _tags(data)
        source = f'the ICC profile "{_name(tags)}"' if _name(tags) else source
        kind, space, connection = data[12:16], data[16:20], data[20:24]
        if kind not in (b"scnr", b"mntr", b"prtr", b"spac"):
            raise InputError("is no profile of photographs")
        if space not in (b"RGB ", b"GRAY"):
            raise InputError(f"is of {_printable(space.decode('latin-1'))}, not of RGB or gray")
        names = (b"kTRC",) if space == b"GRAY" else (b"rTRC", b"gTRC", b"bTRC")
        if any(name not in tags for name in names):
            raise InputError("is a table of colours without tone curves")
        if connection != b"XYZ ":
            raise InputError("has tone curves in CIELab")
        response = plain(_joined([tags[name] for name in names]))
        if space == b"GRAY":
            return Colour(source=source, response=response)
        columns = [tags.get(name, b"") for name in (b"rXYZ", b"gXYZ", b"bXYZ")]
        if any(len(one) < 20 or one[:4] != b"XYZ " for one in columns):
            return Colour(source=source, response=response, trouble="has no primaries")
        values = [struct.unpack_from(">3i", one, 8) for one in columns]
        return _colour(source, response, torch.tensor(values, dtype=torch.float64).T / 65536)
    except (InputError, struct.error, ValueError) as error:
        why = str(error) if isinstance(error, InputError) else "is damaged"
        return Colour(source=source, trouble=why)


def _colour(source: str, response: Response | None, primaries: Tensor | None) -> Colour:
    """Combine a response and primaries: columns of XYZ adapted to D50, or ``None``."""
    matrix = None if primaries is None else srgb_from_primaries(primaries)
    if matrix is None:
        trouble = "has primaries that span no colours"
        return Colour(source=source, response=response, trouble=trouble)
    same = torch.equal(matrix, torch.eye(3).double())
    return Colour(source=source, response=response, srgb_from_file=None if same else matrix)


def _tags(data: bytes) -> dict[bytes, bytes]:
    """Return the contents of the tags whose offsets are inside of the profile."""
    if not _HEADER + 4 <= len(data) <= _MAX_BYTES or data[36:40] != b"acsp":
        raise InputError("is damaged")
    (count,) = struct.unpack_from(">I", data, _HEADER)
    if count > _MAX_TAGS or _HEADER + 4 + _ENTRY * count > len(data):
        raise InputError("is damaged")
    tags = {}
    for index in range(count):
        name, at, size = struct.unpack_from(">4sII", data, _HEADER + 4 + _ENTRY * index)
        if at + size <= len(data):
            tags[name] = data[at : at + size]
    return tags


def _name(tags: dict[bytes, bytes]) -> str:
    tag = tags.get(b"desc", b"")
    if tag[:4] == b"desc" and len(tag) >= 12:
        (length,) = struct.unpack_from(">I", tag, 8)
        return _printable(tag[12 : 12 + min(length, 60)].decode("ascii", "ignore"))
    if tag[:4] == b"mluc" and len(tag) >= 28:
        length, at = struct.unpack_from(">II", tag, 20)
        return _printable(tag[at : at + min(length, 120)].decode("utf-16-be", "ignore"))
    return ""


def _printable(text: str) -> str:
    return "".join(one for one in text if one.isprintable() and one != '"').strip()


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
    """Make a response of the radiance that belongs to levels evenly spaced from 0 to 1."""
    highest = radiance.clamp_min(0).cummax(dim=0).values
    sound = bool(radiance.isfinite().all()) and float((highest - radiance).max()) < _MAX_FALL
    if not sound or float(highest[-1] - highest[0]) < _MIN_RISE:
        raise InputError("has a tone curve that does not rise")
    level = torch.linspace(0, 1, len(radiance), dtype=torch.float64)
    rising = highest + 1e-6 * level  # also where levels have one radiance
    return Curve(encoded=level, radiance=(rising / rising[-1])[None])


def _joined(tags: Sequence[bytes]) -> Response:
    """Read the tone curve of all colours, which is one as a rule, or one each."""
    if len({*tags}) == 1:
        return _curve(tags[0])
    curves = [_curve(tag) for tag in tags]
    tables = [one for one in curves if isinstance(one, Curve)]
    if len(tables) == len(curves) and len({len(one.encoded) for one in tables}) == 1:
        rows = torch.cat([one.radiance for one in tables])
        return Curve(encoded=tables[0].encoded, radiance=rows)
    rows = torch.stack([one.linear_from_encoded(_LEVELS) for one in curves])
    return Curve(encoded=_LEVELS, radiance=rows)


# Of ITU-T H.273, as PNG's cICP and HEIC have them.
_PRIMARIES: Mapping[int, Chromaticities] = {1: REC_709, 9: REC_2020, 12: DISPLAY_P3}
_REC_709_CURVE = (1, 6, 14, 15)


def colour_of_codes(primaries: int, curve: int, source: str) -> Colour:
    """Follow the numbers of ITU-T H.273 for primaries and transfer.

    Args:
        primaries: 1 sRGB's, 9 BT.2020, 12 Display P3; 2 where not stated.
        curve: 13 sRGB, 8 linear, 1, 6, 14 and 15 BT.709; 2 where not stated.
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


# sRGB's, as PNG holds them: white, red, green and blue.
_SRGB_XY = tuple(part for point in (REC_709[3], *REC_709[:3]) for part in point)
# Choices: programs round PNG's 0.45455 and EXIF's 2.2, which mean sRGB, and chromaticities.
_SRGB_GAMMA, _NEAR, _NEAR_XY = 2.2, 0.02, 0.005


def colour_of_info(info: Mapping[Any, Any], cicp: bytes = b"") -> Colour:
    """Follow the first that a file has of PNG's cICP, a profile, PNG's sRGB, and gAMA with cHRM.

    Args:
        info: Pillow's, of an opened file.
        cicp: Content of PNG's chunk, which Pillow passes over.
    """
    if cicp:
        primaries, curve, matrix, full = cicp if len(cicp) == 4 else (0, 0, 0, 0)
        if (matrix, full) != (0, 1):
            return Colour(source="PNG's cICP", trouble="tells of samples that are no RGB")
        return colour_of_codes(primaries, curve, "PNG's cICP")
    if "icc_profile" in info:
        profile = info["icc_profile"]
        return read_profile(profile if isinstance(profile, bytes) else b"")
    if "srgb" in info:
        return Colour(source="PNG's sRGB", response=Srgb())
    gamma, points = info.get("gamma", 1 / _SRGB_GAMMA), info.get("chromaticity", _SRGB_XY)
    far = max(abs(one - other) for one, other in zip(points, _SRGB_XY, strict=True))
    exponent = 1 / gamma if gamma else 0.0
    if abs(exponent - _SRGB_GAMMA) >= _NEAR or far > _NEAR_XY:
        return Colour(source="PNG", trouble=f"has gAMA {gamma:.5g} and cHRM that are not sRGB's")
    return Colour(source="PNG's gAMA", response=Srgb()) if "gamma" in info else SILENT


def colour_of_exif(exif: Image.Exif) -> Colour:
    """Follow the mark of Adobe RGB that cameras set without a profile; a gamma is not followed."""
    tags = exif.get_ifd(ExifTags.IFD.Exif)
    gamma = tags.get(ExifTags.Base.Gamma)
    if gamma is not None and abs(positive_number(gamma) - _SRGB_GAMMA) >= _NEAR:
        return Colour(source="EXIF", trouble="has a gamma that is not sRGB's")
    marked = tags.get(ExifTags.Base.ColorSpace) == 65535 and ExifTags.IFD.Interop in tags
    index = exif.get_ifd(ExifTags.IFD.Interop).get(ExifTags.Interop.InteropIndex) if marked else ""
    if str(index).strip("\0 ") == "R03":  # Adobe RGB, as DCF 2.0 has it
        return _colour("EXIF (Adobe RGB)", Gamma(exponent=563 / 256), primaries_of(ADOBE_RGB))
    return SILENT
