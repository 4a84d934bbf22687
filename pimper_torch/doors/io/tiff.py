"""TIFF: which page is the picture, and what its samples mean."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import kornia_rs.io
import numpy as np
import tifffile
from PIL import Image, TiffImagePlugin

from pimper_torch.runtime.errors import InputError

Opacity = Literal["none", "alpha", "premultiplied", "unknown"]

_SUBFILE, _OLD_SUBFILE, _BITS, _PHOTOMETRIC = 254, 255, 258, 262
_SUB_IFDS, _EXTRA, _FORMAT = 330, 338, 339
_REDUCED, _MASK = 1, 4  # bits of the subfile's type
_WHITE_IS_ZERO, _GRAY, _RGB, _PALETTE, _CMYK = 0, 1, 2, 3, 5
_NAMES = {
    0: "gray",
    1: "gray",
    2: "RGB",
    5: "CMYK",
    6: "YCbCr",
    8: "CIELab",
    9: "ICC Lab",
    10: "ITU Lab",
    32844: "LogL",
    32845: "LogLuv",
}
_SENSOR = (32803, 34892)  # a colour filter array, or linear raw: DNG
CMYK_CAUTION = (
    "is CMYK, made for printing, and is turned into RGB without its profile; saved as RGB it would "
    "keep the camera's colours"
)
_RAW = (
    "holds what a sensor saw, camera raw by the name of TIFF, or a small copy of it. Give it the "
    "suffix that its camera gives, or develop it to linear TIFF of 16 bits."
)
# What extra samples are: 999 is what CorelDRAW writes for alpha.
_OPACITIES: Mapping[int, Opacity] = {0: "unknown", 1: "premultiplied", 2: "alpha", 999: "alpha"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Where the picture of a file lies, and what its samples mean.

    Attributes:
        page: Number of the directory that holds the picture.
        deep: Read by :func:`read_deep_tiff`: colour or opacity of more than 8 bits.
        inverted: 0 is white, and Pillow does not undo it.
        full: Level of full scale that the file tells.
        cautions: What cannot be followed, or had to be chosen.
    """

    page: int = 0
    deep: bool = False
    inverted: bool = False
    opacity: Opacity = "none"
    full: int = 255
    cautions: tuple[str, ...] = ()


def layout_of(path: Path | str, image: TiffImagePlugin.TiffImageFile) -> Layout:
    """Find the picture among a TIFF's pages, and leave the image at it."""
    page, cautions = _picture(Path(path), image)
    tags: Mapping[int, Any] = image.tag_v2
    bits = tags.get(_BITS, (1,))
    photometric = tags.get(_PHOTOMETRIC, _WHITE_IS_ZERO)
    if 2 in tags.get(_FORMAT, (1,)):
        raise InputError(
            f"{path}: has samples with a sign, whose dark level nobody tells; needed: 8 or 16 bits "
            "without. Save it anew, with 0 for no light."
        )
    extra = tags.get(_EXTRA, ())
    gray = photometric in (_WHITE_IS_ZERO, _GRAY, _PALETTE)
    colours = 4 if photometric == _CMYK else 1 if gray else 3
    extra = extra if extra or len(bits) <= colours else (2,) * (len(bits) - colours)
    kinds: list[Opacity] = [_OPACITIES.get(one, "unknown") for one in extra]
    opacity: Opacity = "unknown" if kinds else "none"
    opacity = next((one for one in kinds if one != "unknown"), opacity)
    if "unknown" in kinds:
        cautions.append(
            "has samples besides its colours whose meaning it does not tell; they are left out"
        )
    if photometric == _CMYK:
        cautions.append(CMYK_CAUTION)
    return Layout(
        page=page,
        deep=len(bits) > 1 and max(bits) > 8,
        inverted=photometric == _WHITE_IS_ZERO and max(bits) > 8,
        opacity=opacity,
        full=2 ** max(8, min(16, int(max(bits)))) - 1,
        cautions=tuple(cautions),
    )


def _picture(path: Path, image: TiffImagePlugin.TiffImageFile) -> tuple[int, list[str]]:
    """Go to the largest page that is no reduced copy and no mask; of equals the first."""
    most = 100  # stacks of microscopes have more, and are no photographs
    count = min(getattr(image, "n_frames", 1), most + 1)
    if count == 1:
        _refuse_thumbnail(path, image)
        return 0, []
    if count > most:
        raise InputError(f"{path}: has more than {most} pages; needed: one photograph a file.")
    sizes = []
    for page in range(count):
        try:
            image.seek(page)
        except (SyntaxError, ValueError):  # of samples that Pillow has no name for
            sizes.append(0)
            continue
        kind = image.tag_v2.get(_SUBFILE, 1 if image.tag_v2.get(_OLD_SUBFILE) == 2 else 0)
        whole = not kind & (_REDUCED | _MASK)
        sizes.append(image.size[0] * image.size[1] if whole else 0)
    best = sizes.index(max(sizes))
    image.seek(best)
    _refuse_thumbnail(path, image)
    again = sizes.count(sizes[best])
    if again == 1 or max(sizes) == 0:
        return best, []
    return best, [f"has {again} pages of one size, of which the first is read"]


def _refuse_thumbnail(path: Path, image: TiffImagePlugin.TiffImageFile) -> None:
    """Refuse a reduced copy whose original lies in a directory below it, as in camera raw."""
    tags = image.tag_v2
    if tags.get(_PHOTOMETRIC) in _SENSOR or (
        tags.get(_SUBFILE, 0) & _REDUCED and _SUB_IFDS in tags
    ):
        raise InputError(f"{path}: {_RAW}")


def read_deep_tiff(path: Path | str, layout: Layout) -> np.ndarray:
    """Read colour of more than 8 bits, ``height width channel``; opacity comes last."""
    with tifffile.TiffFile(path) as file:
        page = file.pages[layout.page]
        assert isinstance(page, tifffile.TiffPage), "read one by one, pages are whole"
        samples, interleaved = page.samplesperpixel, page.planarconfig == 1
        plain = (page.bitspersample, page.sampleformat, page.photometric) == (16, 1, _RGB)
        if plain and interleaved and samples == 3 and layout.page == 0:
            # LZW and PackBits, which tifffile reads only with a further package.
            return np.asarray(kornia_rs.io.read_image_tiff_u16(str(path), "rgb"))
        array = page.asarray()
        array = array if interleaved else np.moveaxis(array, 0, -1)
        if array.dtype not in (np.uint8, np.uint16):
            return array  # the caller refuses it
        return _as_colour(array, page, layout)


def _as_colour(array: np.ndarray, page: tifffile.TiffPage, layout: Layout) -> np.ndarray:
    full, colours = np.uint32(layout.full), 4 if page.photometric == _CMYK else 3
    colour, opacity = array[..., :colours], array[..., colours : colours + 1]
    if page.photometric == _CMYK:  # as Pillow does with 8 bits
        light = full - np.minimum(colour, full).astype(np.uint32)
        colour = (light[..., :3] * light[..., 3:] + full // 2) // full
    if layout.opacity in ("none", "unknown"):
        return colour.astype(np.uint16)
    if layout.opacity == "premultiplied":
        whole = np.maximum(opacity.astype(np.uint32), 1)
        colour = np.minimum((colour.astype(np.uint32) * full + whole // 2) // whole, full)
    return np.concatenate([colour.astype(np.uint16), opacity], axis=-1)


def read_gray_tiff(image: Image.Image, layout: Layout | None) -> np.ndarray:
    """Read gray of 16 bits without opacity from Pillow's image, dark at 0."""
    array = np.asarray(image).astype(np.uint16)
    if layout is None or not layout.inverted:
        return array
    return (layout.full - np.minimum(array, layout.full)).astype(np.uint16)


def unread_tiff(path: Path | str) -> str:
    """Return the reason why Pillow does not know a TIFF: kind of samples, sentence, or empty."""
    try:
        with tifffile.TiffFile(path) as file:
            page = file.pages.first
            if int(page.photometric) in _SENSOR:
                return _RAW
            kind, photometric = page.dtype, int(page.photometric)
            if kind is None or kind not in (np.uint8, np.uint16):
                return "" if kind is None else str(kind)
            colour = _NAMES.get(photometric, f"photometric interpretation {photometric}")
            return (
                f"holds {colour} of {page.bitspersample} bits, {page.samplesperpixel} samples a "
                "pixel; needed: RGB or gray of 8 or 16 bits (gray of 16 without transparency). "
                "Save it so."
            )
    except Exception:  # tifffile raises whatever its parser does: no TIFF, then
        return ""
