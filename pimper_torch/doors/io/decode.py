"""One image file to its samples, at full depth and the right way up."""

import io
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import kornia_rs.io
import numpy as np
import torch
from jaxtyping import Float
from PIL import ExifTags, Image, ImageOps, TiffImagePlugin, UnidentifiedImageError
from torch import Tensor

from pimper_torch.doors.io import profiles, tiff
from pimper_torch.doors.io.extras import extra_of, format_of
from pimper_torch.doors.io.header import Header, focal_from_exif
from pimper_torch.doors.io.heic import read_heic, read_heic_header
from pimper_torch.doors.io.raw import read_raw, read_raw_header
from pimper_torch.ground.radiometry.colour import SILENT, Colour
from pimper_torch.records import Record
from pimper_torch.runtime.errors import InputError

Result = TypeVar("Result")

_FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "PPM")  # the last two hold published data sets
# Choices: the largest sensors have 151 million pixels, in files of 1 GB at most; no photograph of
# more than 32 million has less than a bit in 25 samples: pictures made to exhaust memory do.
MAX_PIXELS, _MAX_BYTES = 160_000_000, 2**31
_MANY_PIXELS, _MAX_SAMPLES_PER_BYTE = 32_000_000, 200
_FULL_SCALE = {np.dtype(kind): int(np.iinfo(kind).max) for kind in (np.uint8, np.uint16)}


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Decoded(Record):
    """Samples of a file, the right way up.

    Attributes:
        samples: In [0, 1] as the file encodes them; one or three channels.
        alpha: Opacity in [0, 1]; ``None`` where the file has none.
        lossy: True for JPEG, whose samples ring round edges.
        full: Level of the file that is full scale, a sample of 1: 255, 65535, or what the file
            says.
        colour: What the file says about its samples.
    """

    samples: Float[Tensor, "channel height width"]
    alpha: Float[Tensor, "height width"] | None
    lossy: bool
    full: int
    full_told: bool = False
    colour: Colour = SILENT

    @property
    def bits(self) -> int:
        """Of the file's samples: 8 or 16."""
        return 8 if self.full == _FULL_SCALE[np.dtype(np.uint8)] else 16


def read_header(path: Path | str) -> Header:
    """Read size, orientation and focal length of an image file.

    Raises:
        InputError: Names a file that is no JPEG, PNG or TIFF, HEIC or camera raw, is damaged,
            is too large to be a photograph, or needs a package that is not installed.
    """
    path = Path(path)
    extra = extra_of(path)
    if extra:
        header = _guarded(path, lambda: _header_of_extra(path, extra))
        _refuse_huge(path, header.width, header.height, header.channels)
        return header

    def read(image: Image.Image) -> Header:
        layout = None
        if isinstance(image, TiffImagePlugin.TiffImageFile):
            layout = tiff.layout_of(path, image)
        png = profiles.png_head(path) if image.format == "PNG" else None
        width, height = image.size
        grey = image.mode in ("1", "L", "LA", "La") or image.mode.startswith("I;16")
        _refuse_huge(path, width, height, 1 if grey else 3)
        # Pillow decodes all of a PNG to find out that it has no EXIF.
        exif = Image.Exif() if png is not None and png.bare else image.getexif()
        orientation, cautions = _orientation(exif)
        if orientation >= 5 and layout is None:  # Pillow has turned a TIFF's size
            width, height = height, width
        deep = layout.deep if layout else png is not None and _is_deep_png(path)
        cmyk = image.mode == "CMYK" and layout is None
        sixteen = deep or image.mode.startswith("I;16")
        return Header(
            width=width,
            height=height,
            orientation=orientation,
            focal_px=focal_from_exif(exif.get_ifd(ExifTags.IFD.Exif), width, height),
            channels=1 if grey else 3,
            deep=deep,
            full=layout.full if layout else 2 ** (16 if sixteen else 8) - 1,
            colour=_colour(image, exif, png),
            cautions=(*cautions, *[tiff.CMYK_CAUTION] * cmyk, *(layout.cautions if layout else ())),
            layout=layout,
        )

    return _with_image(path, read, whole=False)


def _header_of_extra(path: Path, extra: str) -> Header:
    if path.stat().st_size > _MAX_BYTES:  # before a library reads it into memory
        raise InputError(
            f"{path}: has {path.stat().st_size} bytes; needed: at most {_MAX_BYTES // 2**30} GB. "
            "Scale it down."
        )
    return read_heic_header(path) if extra == "heic" else read_raw_header(path)


def _guarded(path: Path, read: Callable[[], Result]) -> Result:
    """Turn whatever a library raises of a file into one error."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # size below Pillow's limit, odd but legible tags
            return read()
    except (InputError, MemoryError):
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
    except Exception as error:  # libraries raise whatever a damaged file leads to
        raise _damaged(path) from error


def decode(path: Path | str) -> Decoded:
    """Read an image file at full depth and turn it as EXIF says.

    Profiles are not applied; what they say comes along.

    Raises:
        InputError: As :func:`read_header`, and for samples that are not of 8 or 16 bits.
    """
    path = Path(path)
    header = read_header(path)
    extra = extra_of(path)
    if extra == "heic":
        array = _guarded(path, lambda: read_heic(path))
    elif extra == "raw":
        array = rotated(_guarded(path, lambda: read_raw(path)), header.orientation)
    elif header.deep:
        array = rotated(_read_deep(path, header.layout), header.orientation)
    else:
        array = _with_image(path, lambda image: _read_shallow(image, header.layout))
    if array.dtype not in (np.uint8, np.uint16):
        raise _unfit(path, str(array.dtype))
    full = _full_scale(array, header)
    array = array[..., None] if array.ndim == 2 else array
    if array.shape[:2] != (header.height, header.width):
        raise _damaged(path)
    # Plane by plane, so that no more memory is taken than is returned.
    planes = torch.empty(array.shape[2], *array.shape[:2])
    for plane, channel in zip(planes, np.moveaxis(array, -1, 0), strict=True):
        np.divide(channel, np.float32(full), out=plane.numpy())
    has_alpha = len(planes) in (2, 4)
    return Decoded(
        samples=planes[:-1] if has_alpha else planes,
        alpha=planes[-1] if has_alpha else None,
        lossy=format_of(path) in ("JPEG", "HEIC"),
        full=full,
        full_told=header.full_told,
        colour=header.colour,
    )


def write_deep_png(samples: np.ndarray, path: Path | str) -> None:
    """Write 16-bit colour, ``height width 3``, which Pillow would cut to 8 bits."""
    kornia_rs.io.write_image_png_u16(str(path), samples, mode="rgb")


def rotated(array: np.ndarray, orientation: int) -> np.ndarray:
    """Turn rows and columns so that an image of this EXIF orientation stands upright."""
    if orientation >= 5:
        array = array.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        array = array[::-1]
    if orientation in (2, 3, 6, 7):
        array = array[:, ::-1]
    return np.ascontiguousarray(array)


def _orientation(exif: Image.Exif) -> tuple[int, list[str]]:
    found = exif.get(ExifTags.Base.Orientation)
    if isinstance(found, int) and 1 <= found <= 8:
        return found, []
    if found is None:
        return 1, []
    return 1, [f"has an EXIF orientation of {found!r:.20}, not of 1 to 8; it is taken as upright"]


def _full_scale(array: np.ndarray, header: Header) -> int:
    """Return the level of full scale, as the file says unless its samples contradict it."""
    most = _FULL_SCALE[array.dtype]
    return header.full if array.dtype == np.uint16 and int(array.max()) <= header.full else most


def _colour(image: Image.Image, exif: Image.Exif, png: profiles.PngHead | None) -> Colour:
    """Return what an image says of its samples: by its format's own means, or else by EXIF."""
    if image.mode in ("CMYK", "LAB"):  # turned into sRGB by Pillow
        return SILENT
    if isinstance(image, TiffImagePlugin.TiffImageFile):
        said = profiles.colour_of_tiff(image.tag_v2)
    elif png is not None:
        said = profiles.colour_of_png(png.chunks)
    else:
        profile = image.info.get("icc_profile")
        said = profiles.read_profile(profile) if isinstance(profile, bytes) else SILENT
    return profiles.colour_of_exif(exif) if said is SILENT else said


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
    """Open a file with Pillow.

    Args:
        whole: Read all of it at once; not needed for its header.
    """

    def read() -> Result:
        with path.open("rb") as file:
            # From memory: Pillow 13 misreads an uncompressed, turned TIFF that it maps.
            source = io.BytesIO(file.read()) if whole else file
            with Image.open(source, formats=_FORMATS) as image:
                return use(image)

    return _guarded(path, read)


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
    """Return the refusal of a file unknown to Pillow: a TIFF of other samples, or no image."""
    found = tiff.unread_tiff(path)
    if found.startswith(("float", "int", "uint", "complex")):
        return _unfit(path, found)
    if found:
        return InputError(f"{path}: {found}")
    name = format_of(path)
    content = f", but {name}" if name and name not in _FORMATS else ""
    return InputError(
        f"{path}: holds no JPEG, PNG or TIFF image that can be read{content}. Convert it, or take "
        "it out of the folder."
    )


def _read_shallow(image: Image.Image, layout: tiff.Layout | None) -> np.ndarray:
    if layout is not None:
        image.seek(layout.page)
    upright = ImageOps.exif_transpose(image)
    if upright.mode.startswith("I;16"):
        return tiff.read_gray_tiff(upright, layout)
    if upright.mode in ("I", "F"):
        return np.asarray(upright)  # 32 bits: the caller refuses them
    if upright.mode == "La":
        upright = upright.convert("LA")
    if upright.has_transparency_data:
        return np.asarray(upright.convert("LA" if upright.mode in ("L", "LA") else "RGBA"))
    return np.asarray(upright.convert("L" if upright.mode in ("1", "L") else "RGB"))


def _is_deep_png(path: Path) -> bool:
    with path.open("rb") as file:
        start = file.read(26)
    return start[24] == 16 and start[25] in (2, 4, 6)  # bit depth; RGB, LA, RGBA


def _read_deep(path: Path, layout: tiff.Layout | None) -> np.ndarray:
    try:
        return _read_deep_png(path) if layout is None else tiff.read_deep_tiff(path, layout)
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
