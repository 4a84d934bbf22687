"""Colour metadata of image files: profiles, chunks of PNG, tags of TIFF and EXIF."""

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import torch
from PIL import ExifTags, Image

from pimper_torch.errors import InputError
from pimper_torch.io.icc import read_profile, table
from pimper_torch.radiometry import Gamma, Linear, Response, Srgb
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

_MAX_CHUNK_BYTES = 2**22  # a choice: printers' profiles have 2 MB
_CHUNKS = (b"cICP", b"iCCP", b"sRGB", b"gAMA", b"cHRM", b"sBIT", b"tRNS")
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
        source: Where it stands, for messages.
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
