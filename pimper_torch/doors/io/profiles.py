"""Colour metadata of image files: ICC profiles, chunks of PNG, tags of TIFF and EXIF.

Source of the profiles, which anybody may have written: ICC.1:2022, sections 7 (header, table of
tags) and 10 (``curv``, ``para``, ``XYZ``, ``desc`` and ``mluc``). Profiles that are tables of
colours (``A2B0``) and nothing else are not followed.
"""

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import torch
from jaxtyping import Float
from PIL import ExifTags, Image
from torch import Tensor

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
_STEPS = 4097  # of a parametric curve
_CAMERAS_AND_SPACES = (b"scnr", b"mntr", b"prtr", b"spac")
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
        if kind not in _CAMERAS_AND_SPACES:
            raise InputError("is no profile of photographs")
        if space not in (b"RGB ", b"GRAY"):
            raise InputError(f"is of {_text(space)}, not of RGB or gray")
        names = (b"kTRC",) if space == b"GRAY" else (b"rTRC", b"gTRC", b"bTRC")
        if any(name not in tags for name in names):
            raise InputError("is a table of colours without tone curves")
        if connection != b"XYZ ":
            raise InputError("has tone curves in CIELab")
        response = plain(_one(tuple(_curve(tags[name]) for name in names)))
        matrix, trouble = None, ""
        if space == b"RGB ":
            matrix, trouble = _primaries(tags)
        return Colour(source=source, response=response, srgb_from_file=matrix, trouble=trouble)
    except (InputError, struct.error, ValueError) as error:
        why = str(error) if isinstance(error, InputError) else "is damaged"
        return Colour(source=source, trouble=why)


def _tags(data: bytes) -> dict[bytes, bytes]:
    """Return what the tags hold, once every offset was seen to lie inside."""
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
        return _text(tag[12 : 12 + min(length, 60)])
    if tag[:4] == b"mluc" and len(tag) >= 28:
        length, at = struct.unpack_from(">II", tag, 20)
        return _shown(tag[at : at + min(length, 120)].decode("utf-16-be", "ignore"))
    return ""


def _text(data: bytes) -> str:
    return _shown(data.decode("ascii", "ignore"))


def _shown(text: str) -> str:
    return "".join(one for one in text if one.isprintable() and one != '"').strip()


def _curve(tag: bytes) -> Response:
    if tag[:4] == b"curv":
        return _sampled(tag)
    if tag[:4] == b"para":
        return _parametric(tag)
    raise InputError("has tone curves of an unknown type")


def _sampled(tag: bytes) -> Response:
    (count,) = struct.unpack_from(">I", tag, 8)
    if count > 65536 or 12 + 2 * count > len(tag):
        raise InputError("has a tone curve that is cut short")
    if count == 0:
        return Linear()
    if count == 1:
        return _power(struct.unpack_from(">H", tag, 12)[0] / 256)
    values = torch.frombuffer(bytearray(tag[12 : 12 + 2 * count]), dtype=torch.uint8)
    high, low = values.reshape(-1, 2).double().unbind(dim=1)
    return table((256 * high + low) / 65535)


def _parametric(tag: bytes) -> Response:
    (kind,) = struct.unpack_from(">H", tag, 8)
    if kind >= len(_PARAMETERS):
        raise InputError("has a tone curve of an unknown function")
    values = struct.unpack_from(f">{_PARAMETERS[kind]}i", tag, 12)
    g, a, b, c, d, e, f = (*(value / 65536 for value in values), *(0.0,) * 7)[:7]
    if kind == 0:
        return _power(g)
    if a == 0:
        raise InputError("has a tone curve that is flat")
    level = torch.linspace(0, 1, _STEPS, dtype=torch.float64)
    lifted = (a * level + b).clamp_min(0) ** g
    if kind in (1, 2):
        return table(torch.where(a * level + b >= 0, lifted, 0.0) + (c if kind == 2 else 0.0))
    straight = c * level + f
    return table(torch.where(level >= d, lifted + (e if kind == 4 else 0.0), straight))


def _power(exponent: float) -> Response:
    if not 0.1 <= exponent <= 10:
        raise InputError(f"has a gamma of {exponent:.4g}")
    return Linear() if exponent == 1 else Gamma(exponent=exponent)


def table(radiance: Float[Tensor, " entry"]) -> Curve:
    """Make a response of the radiance that belongs to levels evenly spaced from 0 to 1."""
    highest = radiance.clamp_min(0).cummax(dim=0).values
    sound = bool(radiance.isfinite().all()) and float((highest - radiance).max()) < _MAX_FALL
    if not sound or float(highest[-1] - highest[0]) < _MIN_RISE:
        raise InputError("has a tone curve that does not rise")
    level = torch.linspace(0, 1, len(radiance), dtype=torch.float64)
    rising = highest + 1e-6 * level  # levels of one radiance do not make it stand still
    return Curve(encoded=level, radiance=(rising / rising[-1])[None])


def _one(curves: tuple[Response, ...]) -> Response:
    """Join the responses of three colours, which are one as a rule."""
    if all(isinstance(one, Linear) for one in curves):
        return Linear()
    first = curves[0]
    if isinstance(first, Gamma) and all(one == first for one in curves):
        return first
    level = torch.linspace(0, 1, _STEPS, dtype=torch.float64)
    same_axis = {len(one.encoded) if isinstance(one, Curve) else 0 for one in curves}
    if len(same_axis) == 1 and 0 not in same_axis:
        rows = torch.cat([one.radiance for one in curves if isinstance(one, Curve)])
        level = first.encoded if isinstance(first, Curve) else level
    else:
        rows = torch.stack([one.linear_from_encoded(level) for one in curves])
    same = len(rows) == 1 or bool((rows == rows[:1]).all())
    return Curve(encoded=level, radiance=rows[:1] if same else rows)


def _primaries(tags: dict[bytes, bytes]) -> tuple[Tensor | None, str]:
    columns = [tags.get(name, b"") for name in (b"rXYZ", b"gXYZ", b"bXYZ")]
    if any(len(one) < 20 or one[:4] != b"XYZ " for one in columns):
        return None, "has no primaries"
    values = [struct.unpack_from(">3i", one, 8) for one in columns]
    matrix = srgb_from_primaries(torch.tensor(values, dtype=torch.float64).T / 65536)
    if matrix is None:
        return None, "has primaries that span no colours"
    return (None, "") if torch.equal(matrix, torch.eye(3).double()) else (matrix, "")


_MAX_CHUNK_BYTES = 2**22  # a choice: printers' profiles have 2 MB
_CHUNKS = (b"cICP", b"iCCP", b"sRGB", b"gAMA", b"cHRM")
# PNG's 45455 stands for sRGB in files of programs older than its `sRGB` chunk, and of some newer.
_SRGB_GAMMA, _NEAR = 2.2, 0.02
_ICC_PROFILE, _TRANSFER_FUNCTION = 34675, 301  # tags of TIFF
_EXIF_GAMMA, _UNCALIBRATED, _ADOBE = 0xA500, 65535, "R03"
# Of ITU-T H.273, as cICP and HEIC have them.
_PRIMARIES: Mapping[int, Chromaticities] = {1: REC_709, 9: REC_2020, 12: DISPLAY_P3}
_REC_709_CURVE = (1, 6, 14, 15)


@dataclass(frozen=True, slots=True, kw_only=True)
class PngHead:
    """The chunks before a PNG's pixels.

    Attributes:
        chunks: Those that tell of samples, by name.
        bare: No EXIF and no text, in which EXIF may stand, anywhere in the file.
    """

    chunks: Mapping[bytes, bytes] = field(default_factory=dict)
    bare: bool = False


def png_head(path: Path | str) -> PngHead:
    """Walk over a PNG's chunks, reading only those that tell of samples."""
    chunks: dict[bytes, bytes] = {}
    bare, told = True, True
    with Path(path).open("rb") as file:
        file.seek(8)
        while len(head := file.read(8)) == 8:
            length, kind = int.from_bytes(head[:4], "big"), head[4:]
            if kind in (b"eXIf", b"tEXt", b"zTXt", b"iTXt"):
                bare = False
            told = told and kind != b"IDAT"
            if not told and not bare:
                break
            if told and kind in _CHUNKS and kind not in chunks and length <= _MAX_CHUNK_BYTES:
                chunks[kind] = file.read(length)
                file.seek(4, 1)
            else:
                file.seek(length + 4, 1)
    return PngHead(chunks=chunks, bare=bare)


def colour_of_png(chunks: Mapping[bytes, bytes]) -> Colour:
    """Follow the chunk that comes first: cICP, iCCP, sRGB, gAMA with cHRM, as PNG says."""
    try:
        if b"cICP" in chunks:
            primaries, curve, matrix, full = struct.unpack(">4B", chunks[b"cICP"])
            return colour_of_codes(primaries, curve, "PNG's cICP", narrow=full != 1 or matrix != 0)
        if b"iCCP" in chunks:
            return read_profile(_inflated(chunks[b"iCCP"]))
        if b"sRGB" in chunks:
            return Colour(source="PNG's sRGB", response=Srgb())
        if b"gAMA" in chunks:
            (number,) = struct.unpack(">I", chunks[b"gAMA"])
            return _of_gamma(number, chunks.get(b"cHRM", b""))
    except (struct.error, zlib.error) as error:
        return Colour(source="PNG", trouble=f"has a damaged chunk ({error})")
    return SILENT


def _inflated(chunk: bytes) -> bytes:
    name, _, rest = chunk.partition(b"\0")
    if len(name) > 79 or rest[:1] != b"\0":
        raise zlib.error("no profile")
    return zlib.decompressobj().decompress(rest[1:], _MAX_CHUNK_BYTES)


def _of_gamma(number: int, chromaticities: bytes) -> Colour:
    source = f"PNG's gAMA {number / 1e5:g}"
    if not 10_000 <= number <= 1_000_000:
        return Colour(source=source, trouble="is no gamma of samples")
    exponent = 1e5 / number
    response: Response = Gamma(exponent=exponent)
    if abs(exponent - _SRGB_GAMMA) < _NEAR:
        response = Srgb()
    elif abs(exponent - 1) < 1e-3:
        response = Linear()
    if len(chromaticities) != 32:
        return Colour(source=source, response=response)
    white, *others = zip(*[iter(struct.unpack(">8I", chromaticities))] * 2, strict=True)
    told = tuple((x / 1e5, y / 1e5) for x, y in (*others, white))
    return _with_primaries(source, response, told)


def colour_of_codes(primaries: int, curve: int, source: str, *, narrow: bool = False) -> Colour:
    """Follow the numbers of ITU-T H.273 for primaries and transfer.

    Args:
        primaries: 1 sRGB's, 9 BT.2020, 12 Display P3; 2 where they are not told.
        curve: 13 sRGB, 8 linear, 4 and 5 gamma 2.2 and 2.8, 1, 6, 14 and 15 BT.709; 2 where it
            is not told.
        narrow: Samples are no RGB over the full range.
    """
    response: Response | None
    if narrow:
        return Colour(source=source, trouble="tells of samples that are no RGB of full range")
    if curve == 2:
        response = None
    elif curve in _REC_709_CURVE:
        level = torch.linspace(0, 1, 4097, dtype=torch.float64)
        curved = ((level + 0.099) / 1.099) ** (1 / 0.45)
        response = table(torch.where(level < 0.081, level / 4.5, curved))
    elif curve in (4, 5):
        response = Gamma(exponent=2.2 if curve == 4 else 2.8)
    elif curve in (8, 13):
        response = Linear() if curve == 8 else Srgb()
    else:
        return Colour(source=source, trouble=f"names transfer {curve}, of HDR or film")
    if primaries == 2:
        return Colour(source=source, response=response)
    if primaries not in _PRIMARIES:
        return Colour(source=source, response=response, trouble=f"names primaries {primaries}")
    return _with_primaries(source, response, _PRIMARIES[primaries])


def _with_primaries(source: str, response: Response | None, told: Chromaticities) -> Colour:
    xyz = primaries_of(told)
    matrix = None if xyz is None else srgb_from_primaries(xyz)
    if matrix is None:
        trouble = "has primaries that span no colours"
        return Colour(source=source, response=response, trouble=trouble)
    same = torch.equal(matrix, torch.eye(3).double())
    return Colour(source=source, response=response, srgb_from_file=None if same else matrix)


def colour_of_exif(exif: Image.Exif) -> Colour:
    """Follow EXIF's gamma, and the mark of Adobe RGB that cameras set without a profile."""
    tags = exif.get_ifd(ExifTags.IFD.Exif)
    gamma = tags.get(_EXIF_GAMMA)
    if gamma is not None:
        try:
            exponent = float(gamma)
        except (TypeError, ValueError, ZeroDivisionError):
            exponent = 0.0
        if not 0.1 <= exponent <= 10:
            return Colour(source="EXIF's gamma", trouble="is no number")
        near = abs(exponent - _SRGB_GAMMA) < _NEAR
        return Colour(
            source=f"EXIF's gamma {exponent:g}",
            response=Srgb() if near else plain(Gamma(exponent=exponent)),
        )
    if tags.get(ExifTags.Base.ColorSpace) != _UNCALIBRATED:
        return SILENT
    index = exif.get_ifd(ExifTags.IFD.Interop).get(ExifTags.Interop.InteropIndex)
    if str(index).strip("\0 ") == _ADOBE:
        return _with_primaries("EXIF (Adobe RGB)", Gamma(exponent=563 / 256), ADOBE_RGB)
    return SILENT


def colour_of_tiff(tags: Mapping[int, object]) -> Colour:
    """Follow TIFF's profile, or else its TransferFunction."""
    profile = tags.get(_ICC_PROFILE)
    if isinstance(profile, bytes):
        return read_profile(profile)
    levels = tags.get(_TRANSFER_FUNCTION)
    if not isinstance(levels, tuple):
        return SILENT
    source, count = "TIFF's TransferFunction", len(levels)
    entries = next((size for size in (256, 65536) if count in (size, 3 * size)), 0)
    try:
        if not entries or any(
            levels[:entries] != levels[at : at + entries] for at in range(0, count, entries)
        ):
            raise InputError("is no table of the file's levels, or one for each colour")
        values = torch.tensor(levels[:entries], dtype=torch.float64) / 65535
        return Colour(source=source, response=plain(table(values)))
    except InputError as error:
        return Colour(source=source, trouble=str(error))
    except (TypeError, ValueError):
        return Colour(source=source, trouble="is damaged")
