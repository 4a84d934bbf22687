"""Decoding of image files to upright samples at full bit depth."""

import io
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import tifffile
import torch
from jaxtyping import Float, Integer
from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError
from torch import Tensor

from pimper_torch.io import profiles, tiff
from pimper_torch.io.extras import extra_of, format_of
from pimper_torch.io.header import Header, focal_from_exif
from pimper_torch.io.heic import read_heic, read_heic_header
from pimper_torch.io.raw import read_raw, read_raw_header
from pimper_torch.radiometry.colour import SILENT, Colour
from pimper_torch.records import Record
from pimper_torch.records.shapes import Map
from pimper_torch.runtime.errors import InputError

Result = TypeVar("Result")

_FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "PPM")  # the last two for published data sets
# Choices: the largest sensors have 151 million pixels, in files of at most 1 GB. Photographs of
# more than 32 million pixels have at least a bit per 25 samples; images made to exhaust memory do
# not.
MAX_PIXELS, _MAX_BYTES = 160_000_000, 2**31
_MANY_PIXELS, _MAX_SAMPLES_PER_BYTE = 32_000_000, 200

LABELS = 32
"""A mask or map with only integers below this contains labels. A choice."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Decoded(Record):
    """Upright samples of a file.

    Attributes:
        levels: Integers from 0 to ``full`` as in the file; one or three channels.
        alpha: Opacity in [0, 1]; ``None`` if the file has none.
        lossy: True for JPEG and HEIC, which ring around edges.
        full: Full-scale level of the file, a sample of 1: 255, 65535, or as the file states.
    """

    levels: Integer[Tensor, "channel height width"]
    alpha: Map | None
    lossy: bool
    full: int

    @property
    def samples(self) -> Float[Tensor, "channel height width"]:
        """Levels as fractions of full scale."""
        return self.levels.float() / self.full

    @property
    def bits(self) -> int:
        """Bits of the file's samples: 8 or 16."""
        return 8 if self.full == 255 else 16


def read_header(path: Path | str) -> Header:
    """Read size, orientation and focal length of an image file.

    Raises:
        InputError: Names a file that is not JPEG, PNG, TIFF, HEIC or camera raw, is damaged,
            is too large for a photograph, is CMYK, has several pages, or needs a package that is
            not installed.
    """
    path = Path(path)
    return _guarded(path, lambda: _header_of(path))


def _header_of(path: Path) -> Header:
    if path.stat().st_size > _MAX_BYTES:  # before a library reads it into memory
        raise InputError(
            f"{path}: has {path.stat().st_size} bytes; needed: at most {_MAX_BYTES // 2**30} GB. "
            "Shrink it."
        )
    extra, name = extra_of(path), format_of(path)
    if extra:
        header = read_heic_header(path) if extra == "heic" else read_raw_header(path)
        _refuse_huge(path, header.width, header.height, header.channels)
        return header
    layout = tiff.layout_of(path) if name == "TIFF" else None
    chunks = _png_chunks(path) if name == "PNG" else {}
    with Image.open(path, formats=_FORMATS) as image:
        if image.mode == "CMYK":
            raise InputError(f"{path}: is CMYK, for printing; needed: RGB. {tiff.CONVERT}")
        width, height = image.size
        channels = 1 if image.mode[:4] in ("1", "L", "LA", "I;16") else 3
        _refuse_huge(path, width, height, channels)
        # Pillow decodes a complete PNG to search for EXIF.
        bare = name == "PNG" and not chunks.keys() & {b"eXIf", b"tEXt", b"zTXt", b"iTXt"}
        exif = Image.Exif() if bare else image.getexif()
        colour = profiles.colour_of_info(image.info, chunks.get(b"cICP", b""))
        if colour is SILENT and layout and layout.transfer:
            colour = Colour(source="TIFF", trouble="has a TransferFunction, a table of levels")
        orientation = exif.get(ExifTags.Base.Orientation, 1)
        cautions = []
        if not (isinstance(orientation, int) and 1 <= orientation <= 8):
            cautions.append(
                f"has an EXIF orientation of {orientation!r:.20}, not of 1 to 8; it is treated as "
                "upright"
            )
            orientation = 1
        if layout and layout.unknown:
            cautions.append("has extra samples of unknown meaning, which are ignored")
        if orientation >= 5 and layout is None:  # Pillow already swaps the size of a TIFF
            width, height = height, width
        # 16 bits, and RGB, gray with opacity (which OpenCV expands to four channels), or RGBA.
        deep_png = chunks.get(b"IHDR", b"")[8:] in (b"\x10\x02", b"\x10\x04", b"\x10\x06")
        sixteen = deep_png or image.mode.startswith("I;16")
        return Header(
            width=width,
            height=height,
            orientation=orientation,
            focal_px=focal_from_exif(exif.get_ifd(ExifTags.IFD.Exif), width, height),
            channels=channels,
            deep=layout.deep if layout else deep_png,
            full=layout.full if layout else 2 ** (16 if sixteen else 8) - 1,
            colour=profiles.colour_of_exif(exif) if colour is SILENT else colour,
            cautions=tuple(cautions),
            layout=layout,
        )


def _png_chunks(path: Path) -> dict[bytes, bytes]:
    chunks: dict[bytes, bytes] = {}
    with path.open("rb") as file:
        file.seek(8)
        while len(head := file.read(8)) == 8:
            length = int.from_bytes(head[:4], "big")
            start = file.read(min(length, 10))
            chunks.setdefault(head[4:], start)
            file.seek(length - len(start) + 4, 1)
    return chunks


def _guarded(path: Path, read: Callable[[], Result]) -> Result:
    """Convert errors of libraries about a file to ``InputError``."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # large but allowed sizes, odd but legible tags
            return read()
    except (InputError, MemoryError):
        raise
    except Image.DecompressionBombError as error:
        raise InputError(
            f"{path}: has more than {MAX_PIXELS // 10**6} million pixels; needed: at most that. "
            "Shrink it."
        ) from error
    except UnidentifiedImageError as error:
        name = format_of(path)
        content = f", but {name}" if name and name not in _FORMATS else ""
        raise InputError(
            f"{path}: is not a readable JPEG, PNG or TIFF image{content}. Convert it, or remove it "
            "from the folder."
        ) from error
    except OSError as error:
        if error.errno is not None:  # from the operating system, not a decoder
            raise InputError(f"{path}: cannot be read ({error.strerror}).") from error
        raise _damaged(path) from error
    except Exception as error:  # libraries raise errors of many types for damaged files
        raise _damaged(path) from error


def decode(path: Path | str, least_px: tuple[int, int] | None = None) -> Decoded:
    """Return the samples of an image file at full bit depth, with EXIF's orientation applied.

    Profiles, which the header has as ``colour``, are not applied.

    Args:
        least_px: Width and height that suffice. JPEG is decoded at the smallest of a half, a
            quarter and an eighth of its size that is not below and has no partial blocks.

    Raises:
        InputError: As :func:`read_header`, and for samples that do not have 8 or 16 bits.
    """
    path = Path(path)
    header = read_header(path)
    wide, high = least_px if least_px and format_of(path) == "JPEG" else (math.inf, math.inf)
    fits = (by for by in (8, 4, 2) if header.width >= by * wide and header.height >= by * high)
    shrink = next((by for by in fits if header.width % by == header.height % by == 0), 1)
    array = _guarded(path, lambda: _upright(path, header, shrink))
    if array.dtype not in (np.uint8, np.uint16):
        raise tiff.unfit(path, str(array.dtype))
    array = array[..., None] if array.ndim == 2 else array
    if array.shape[:2] != (header.height // shrink, header.width // shrink):
        raise _damaged(path)
    # As the file states, unless its samples exceed this.
    sixteen = array.dtype == np.uint16
    full = header.full if sixteen and int(array.max()) <= header.full else np.iinfo(array.dtype).max
    planes = torch.from_numpy(np.moveaxis(array, -1, 0).copy())
    has_alpha = len(planes) in (2, 4)
    return Decoded(
        levels=planes[:-1] if has_alpha else planes,
        alpha=planes[-1].float() / int(full) if has_alpha else None,
        lossy=format_of(path) in ("JPEG", "HEIC"),
        full=int(full),
    )


def _upright(path: Path, header: Header, shrink: int) -> np.ndarray:
    """Return upright samples, ``height width`` or ``height width channel`` with opacity last."""
    extra, layout = extra_of(path), header.layout
    if extra == "heic":
        return read_heic(path)
    if extra == "raw":
        return rotated(read_raw(path), header.orientation)
    if header.deep:
        return _read_deep(path, header)
    # From memory: Pillow 13 misreads an uncompressed, rotated TIFF if it maps the file.
    with Image.open(io.BytesIO(path.read_bytes()), formats=_FORMATS) as image:
        image.draft(None, (image.width // shrink, image.height // shrink))
        upright = ImageOps.exif_transpose(image)
        if upright.mode.startswith("I;16"):
            array = np.asarray(upright).astype(np.uint16)
            inverted = layout is not None and layout.inverted
            return header.full - np.minimum(array, header.full) if inverted else array
        if upright.mode in ("I", "F"):
            return np.asarray(upright)  # 32 bits: an error in the caller
        if upright.has_transparency_data:
            return np.asarray(upright.convert("LA" if upright.mode in ("L", "LA") else "RGBA"))
        return np.asarray(upright.convert("L" if upright.mode in ("1", "L") else "RGB"))


def write_deep_png(samples: np.ndarray, path: Path | str) -> None:
    """Write 16-bit colour ``height width 3``, which Pillow would truncate to 8 bits."""
    _, data = cv2.imencode(".png", np.ascontiguousarray(samples[..., ::-1]))
    Path(path).write_bytes(data.tobytes())


def rotated(array: np.ndarray, orientation: int) -> np.ndarray:
    """Return the upright version of an image with this EXIF orientation."""
    if orientation >= 5:
        array = array.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        array = array[::-1]
    if orientation in (2, 3, 6, 7):
        array = array[:, ::-1]
    return np.ascontiguousarray(array)


def _refuse_huge(path: Path, width: int, height: int, channels: int) -> None:
    """Raise an error for an image that would need too much memory, by its header."""
    pixels, size = width * height, path.stat().st_size
    if pixels > MAX_PIXELS:
        raise InputError(
            f"{path}: has {width} x {height} pixels; needed: at most "
            f"{MAX_PIXELS // 10**6} million. Shrink it."
        )
    if channels > 1 and pixels > _MANY_PIXELS and pixels * channels > _MAX_SAMPLES_PER_BYTE * size:
        raise InputError(
            f"{path}: has {width} x {height} pixels in only {size} bytes, unlike a photograph. "
            "Remove it from the folder, or shrink it."
        )


def _damaged(path: Path) -> InputError:
    return InputError(
        f"{path}: cannot be read; it seems cut short, damaged or compressed in an unusual way. "
        "Copy it again, save it again as PNG, or remove it from the folder."
    )


def _read_deep(path: Path, header: Header) -> np.ndarray:
    """Return 16-bit samples in several channels, which Pillow would truncate to 8 bits."""
    layout = header.layout
    if layout and layout.planes:  # OpenCV misreads them
        array = rotated(np.moveaxis(tifffile.imread(path, key=0), 0, -1), header.orientation)
    else:
        level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            decoded = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
        finally:
            cv2.utils.logging.setLogLevel(level)
        if decoded is None:
            raise _damaged(path)
        array = decoded[..., [2, 1, 0, 3][: decoded.shape[2]]]
        if not layout:  # OpenCV already rotates a TIFF
            array = rotated(array, header.orientation)
    return array[..., :3] if layout and layout.unknown else array
