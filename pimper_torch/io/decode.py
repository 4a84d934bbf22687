"""One image file to its samples, at full depth and the right way up."""

import io
import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import kornia_rs.io
import numpy as np
import tifffile
import torch
from jaxtyping import Float
from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.records import Record

Result = TypeVar("Result")

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
_FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "PPM")  # the last two hold published data sets
# Choices: the largest sensors have 151 million pixels, in files of 1 GB at most; no photograph of
# more than 32 million has less than a bit in 25 samples: pictures made to exhaust memory do.
MAX_PIXELS, _MAX_BYTES = 160_000_000, 2**31
_MANY_PIXELS, _MAX_SAMPLES_PER_BYTE = 32_000_000, 200
# Diagonal of the 36 mm x 24 mm frame, to which CIPA DCG-001 relates the 35 mm equivalent.
_FRAME_DIAGONAL_MM = math.hypot(36, 24)
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # EXIF's FocalPlaneResolutionUnit


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Header(Record):
    """What a file says about its image without decoding it.

    Attributes:
        width: Pixels, the right way up.
        height: Pixels, the right way up.
        orientation: EXIF's number, 1 to 8; 1 is upright.
        focal_px: NaN where the file does not say.
        channels: 1 or 3; alpha not counted.
        deep: True for 16-bit samples in several channels, which Pillow would cut to 8.
    """

    width: int
    height: int
    orientation: int
    focal_px: float
    channels: int
    deep: bool


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Decoded(Record):
    """Samples of a file, the right way up.

    Attributes:
        samples: In [0, 1] as the file encodes them; one or three channels.
        alpha: Opacity in [0, 1]; ``None`` where the file has none.
        lossy: True for JPEG, whose samples ring round edges.
        bits: 8 or 16; full scale, a sample of 1, is ``2 ** bits - 1`` in the file.
    """

    samples: Float[Tensor, "channel height width"]
    alpha: Float[Tensor, "height width"] | None
    lossy: bool
    bits: int


def read_header(path: Path | str) -> Header:
    """Read size, orientation and focal length of an image file.

    Raises:
        InputError: Names a file that is no JPEG, PNG or TIFF, is damaged, or is too large
            to be a photograph.
    """
    path = Path(path)

    def read(image: Image.Image) -> Header:
        width, height = image.size
        grey = image.mode in ("1", "L", "LA", "La") or image.mode.startswith("I;16")
        _refuse_huge(path, width, height, 1 if grey else 3)
        exif = Image.Exif() if _is_bare_png(path, image) else image.getexif()
        orientation = _orientation(exif)
        if orientation >= 5 and image.format != "TIFF":  # Pillow has turned a TIFF's size
            width, height = height, width
        return Header(
            width=width,
            height=height,
            orientation=orientation,
            focal_px=focal_from_exif(exif.get_ifd(ExifTags.IFD.Exif), width, height),
            channels=1 if grey else 3,
            deep=_is_deep(path, image),
        )

    return _with_image(path, read, whole=False)


def decode(path: Path | str) -> Decoded:
    """Read an image file at full depth and turn it as EXIF says.

    Colour profiles are not applied.

    Raises:
        InputError: As :func:`read_header`, and for samples that are not of 8 or 16 bits.
    """
    path = Path(path)
    header = read_header(path)
    if header.deep:
        array = rotated(_read_deep(path), header.orientation)
    else:
        array = _with_image(path, _read_shallow)
    if array.dtype not in (np.uint8, np.uint16):
        raise _unfit(path, str(array.dtype))
    array = array[..., None] if array.ndim == 2 else array
    # Plane by plane, so that no more memory is taken than is returned.
    planes = torch.empty(array.shape[2], *array.shape[:2])
    for plane, channel in zip(planes, np.moveaxis(array, -1, 0), strict=True):
        np.divide(channel, np.float32(np.iinfo(array.dtype).max), out=plane.numpy())
    has_alpha = len(planes) in (2, 4)
    return Decoded(
        samples=planes[:-1] if has_alpha else planes,
        alpha=planes[-1] if has_alpha else None,
        lossy=path.suffix.lower() in (".jpg", ".jpeg"),
        bits=8 * array.dtype.itemsize,
    )


def write_deep_png(samples: np.ndarray, path: Path | str) -> None:
    """Write 16-bit colour, ``height width 3``, which Pillow would cut to 8 bits."""
    kornia_rs.io.write_image_png_u16(str(path), samples, mode="rgb")


def focal_from_exif(tags: Mapping[int, object], width: int, height: int) -> float:
    """Give the focal length in pixels of an image of this size; NaN where EXIF is silent.

    From the 35 mm equivalent, which survives resizing, by the diagonal of the frame; else
    from the focal length and the resolution of the focal plane, corrected for a resize
    since the camera wrote ``PixelXDimension``.

    >>> focal_from_exif({0xA405: 50}, width=3600, height=2400)
    5000.0
    """
    equivalent = _positive(tags.get(ExifTags.Base.FocalLengthIn35mmFilm))
    if equivalent:
        return equivalent / _FRAME_DIAGONAL_MM * math.hypot(width, height)
    focal_mm = _positive(tags.get(ExifTags.Base.FocalLength))
    resolution = _positive(tags.get(ExifTags.Base.FocalPlaneXResolution))
    unit = tags.get(ExifTags.Base.FocalPlaneResolutionUnit, 2)
    unit_mm = _MM_PER_UNIT.get(unit) if isinstance(unit, int) else None
    if not (focal_mm and resolution and unit_mm):
        return math.nan
    taken = max(
        _positive(tags.get(ExifTags.Base.ExifImageWidth)),
        _positive(tags.get(ExifTags.Base.ExifImageHeight)),
    )
    resized = max(width, height) / taken if taken else 1.0
    return focal_mm * resolution / unit_mm * resized


def rotated(array: np.ndarray, orientation: int) -> np.ndarray:
    """Turn rows and columns so that an image of this EXIF orientation stands upright."""
    if orientation >= 5:
        array = array.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        array = array[::-1]
    if orientation in (2, 3, 6, 7):
        array = array[:, ::-1]
    return np.ascontiguousarray(array)


def _positive(value: object) -> float:
    """Read a number of EXIF; 0 where it is absent, zero, infinite or nonsense."""
    try:
        number = float(value)  # type: ignore[arg-type]  # anything may stand in a file
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return number if 0 < number < math.inf else 0.0


def _is_bare_png(path: Path, image: Image.Image) -> bool:
    """Tell whether a PNG says nothing but its pixels; Pillow decodes all to find that out."""
    if image.format != "PNG":
        return False
    with path.open("rb") as file:
        file.seek(8)
        while len(head := file.read(8)) == 8:
            if head[4:] in (b"eXIf", b"tEXt", b"zTXt", b"iTXt"):
                return False
            file.seek(int.from_bytes(head[:4], "big") + 4, 1)
    return True


def _orientation(exif: Image.Exif) -> int:
    found = exif.get(ExifTags.Base.Orientation)
    return found if isinstance(found, int) and 1 <= found <= 8 else 1


def _refuse_huge(path: Path, width: int, height: int, channels: int) -> None:
    """Refuse, by its header, an image that memory should not be taken for."""
    pixels, held = width * height, path.stat().st_size
    if pixels > MAX_PIXELS or held > _MAX_BYTES:
        raise InputError(
            f"{path}: has {width} x {height} pixels in {held} bytes; needed: at most "
            f"{MAX_PIXELS // 10**6} million pixels, {_MAX_BYTES // 2**30} GB. Scale it down."
        )
    if channels > 1 and pixels > _MANY_PIXELS and pixels * channels > _MAX_SAMPLES_PER_BYTE * held:
        raise InputError(
            f"{path}: says that it has {width} x {height} pixels in {held} bytes, which no "
            "photograph has. Take it out of the folder, or scale it down."
        )


def _with_image(path: Path, use: Callable[[Image.Image], Result], *, whole: bool = True) -> Result:
    """Open a file with Pillow and turn everything that may go wrong into one error.

    Args:
        path: Of the file.
        use: What to do with it.
        whole: Read all of it at once; not needed for its header.
    """
    try:
        with warnings.catch_warnings(), path.open("rb") as file:
            warnings.simplefilter("ignore")  # size below Pillow's limit, odd but legible tags
            # From memory: Pillow 13 misreads an uncompressed, turned TIFF that it maps.
            source = io.BytesIO(file.read()) if whole else file
            with Image.open(source, formats=_FORMATS) as image:
                return use(image)
    except InputError:
        raise
    except Image.DecompressionBombError as error:
        raise InputError(
            f"{path}: has more than {MAX_PIXELS // 10**6} million pixels; needed: at most as many. "
            "Scale it down."
        ) from error
    except UnidentifiedImageError as error:
        raise _unidentified(path) from error
    except OSError as error:
        if error.errno is not None:  # of the system, not of a decoder
            raise InputError(f"{path}: cannot be read ({error.strerror}).") from error
        raise _damaged(path) from error
    except Exception as error:  # Pillow's plugins raise whatever a damaged file leads to
        raise _damaged(path) from error


def _damaged(path: Path) -> InputError:
    return InputError(
        f"{path}: cannot be read, it seems cut short or damaged. Copy it again, or take it out of "
        "the folder."
    )


def _unfit(path: Path, kind: str) -> InputError:
    return InputError(
        f"{path}: its samples are {kind}; needed: 8 or 16 bits, whole numbers. Save it anew, as "
        "16-bit TIFF for instance, with the level of saturation at full scale."
    )


def _unidentified(path: Path) -> InputError:
    """Tell why Pillow does not know a file: a TIFF of samples that it has no name for, or none."""
    try:
        with tifffile.TiffFile(path) as file:
            kind = file.pages.first.dtype
            if kind is not None and kind not in (np.uint8, np.uint16):
                return _unfit(path, str(kind))
    except Exception:  # tifffile raises whatever its parser does: no TIFF, then
        pass
    return InputError(
        f"{path}: holds no JPEG, PNG or TIFF image that can be read. Convert it, or take it out of "
        "the folder."
    )


def _read_shallow(image: Image.Image) -> np.ndarray:
    upright = ImageOps.exif_transpose(image)
    if upright.mode.startswith("I;16"):
        return np.asarray(upright).astype(np.uint16)
    if upright.mode in ("I", "F"):
        return np.asarray(upright)  # 32 bits: the caller refuses them
    if upright.has_transparency_data:
        return np.asarray(upright.convert("LA" if upright.mode in ("L", "LA") else "RGBA"))
    return np.asarray(upright.convert("L" if upright.mode in ("1", "L") else "RGB"))


def _is_deep(path: Path, image: Image.Image) -> bool:
    if image.format == "PNG":
        with path.open("rb") as file:
            start = file.read(26)
        return start[24] == 16 and start[25] in (2, 4, 6)  # bit depth; RGB, LA, RGBA
    if image.format == "TIFF":
        bits = image.tag_v2.get(258, (1,))  # type: ignore[attr-defined]  # BitsPerSample
        return len(bits) > 1 and max(bits) > 8
    return False


def _read_deep(path: Path) -> np.ndarray:
    try:
        with path.open("rb") as file:
            is_png = file.read(4) == b"\x89PNG"
        if is_png:
            return _read_deep_png(path)
        return _read_deep_tiff(path)
    except InputError:
        raise
    except Exception as error:  # kornia_rs raises bare Exception
        raise InputError(
            f"{path}: its 16-bit samples cannot be read, the file seems damaged or packed in an "
            "unusual way. Save it anew as 16-bit PNG."
        ) from error


def _read_deep_png(path: Path) -> np.ndarray:
    kind = path.read_bytes()[25]
    if kind == 4:
        raise InputError(
            f"{path}: is 16-bit grey with transparency, which cannot be read at full depth. "
            "Save it without transparency."
        )
    return np.asarray(kornia_rs.io.read_image_png_u16(str(path), "rgb" if kind == 2 else "rgba"))


def _read_deep_tiff(path: Path) -> np.ndarray:
    with tifffile.TiffFile(path) as file:
        page = file.pages.first
        samples, interleaved = page.samplesperpixel, page.planarconfig == 1
        if interleaved and samples == 3 and page.bitspersample == 16:
            # LZW and PackBits, which tifffile reads only with a further package.
            return np.asarray(kornia_rs.io.read_image_tiff_u16(str(path), "rgb"))
        array = page.asarray()
    return array if interleaved else np.moveaxis(array, 0, -1)
