"""Sample layout of TIFF files, and checks that they are photographs, by their tags."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import TiffImagePlugin

from pimper_torch.runtime.errors import InputError

_SUBFILE, _OLD_SUBFILE, _WIDTH, _BITS, _PHOTOMETRIC, _SAMPLES = 254, 255, 256, 258, 262, 277
_PLANAR, _TRANSFER, _SUB_IFDS, _EXTRA, _FORMAT = 284, 301, 330, 338, 339
_TAGS = (
    *(_SUBFILE, _OLD_SUBFILE, _WIDTH, _BITS, _PHOTOMETRIC, _SAMPLES),
    *(_PLANAR, _TRANSFER, _SUB_IFDS, _EXTRA, _FORMAT),
)
_WHITE_IS_ZERO, _GRAY, _RGB, _PALETTE, _YCBCR = 0, 1, 2, 3, 6
_NAMES = {0: "gray", 1: "gray", 2: "RGB", 5: "CMYK", 6: "YCbCr", 8: "CIELab", 32845: "LogLuv"}
_KINDS = {1: "uint", 2: "int", 3: "float", 5: "complex int", 6: "complex"}
_SENSOR = (32803, 34892)  # a colour filter array, or linear raw: DNG
_MAX_DIRECTORIES = 100  # a choice: microscope stacks have more, photographs a few small copies
CONVERT = (
    "Convert it to sRGB, for instance with ImageMagick: `magick in.tif -colorspace sRGB out.png`."
)
PREMULTIPLIED = (
    "has colours multiplied by opacity; needed: a photograph without transparency, or with "
    f"straight alpha. {CONVERT}"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Layout of the samples of a TIFF."""

    deep: bool  # 16-bit colour, which Pillow would truncate to 8 bits
    planes: bool  # deep colour in separate planes
    inverted: bool  # 0 is white, and Pillow does not invert it
    full: int  # full-scale level of the file
    transfer: bool  # there is a TransferFunction, a table of radiance
    unknown: bool  # there are extra samples of unknown meaning


def layout_of(path: Path | str) -> Layout:
    """Return the layout of a TIFF with a single photograph of 8 or 16 bits.

    Raises:
        InputError: It has several pages, or its samples are not those of a photograph.
    """
    tags, *others = _directories(Path(path))
    bits, photometric = tags.get(_BITS, (1,)), tags.get(_PHOTOMETRIC, _WHITE_IS_ZERO)
    samples, depth = tags.get(_SAMPLES, len(bits)), max(bits)
    if photometric in _SENSOR or (_is_copy(tags) and _SUB_IFDS in tags):
        raise InputError(
            f"{path}: is camera raw with the suffix of TIFF, or a small copy of it. Rename it to "
            "the suffix of its camera, or develop it to a linear 16-bit TIFF."
        )
    # Thumbnails are not always marked; cameras write thumbnails without a width.
    small = [_is_copy(page) or 2 * page.get(_WIDTH, 0) <= tags[_WIDTH] for page in others]
    if others and (_is_copy(tags) or not all(small)):
        raise InputError(
            f"{path}: has several pages; needed: one photograph per file, followed only by small "
            "copies. Split it, for instance with ImageMagick: `magick in.tif out_%d.tif`."
        )
    kind = _KINDS.get(max(tags.get(_FORMAT, (1,))), "unknown")
    if kind != "uint" or depth > 16:
        raise unfit(path, f"{kind}{depth}")
    gray = photometric in (_WHITE_IS_ZERO, _GRAY)
    deep = depth > 8 and not gray
    if not (
        (depth <= 8 and (gray or photometric in (_RGB, _PALETTE, _YCBCR)))
        or (gray and samples == 1)
        or ({*bits} == {16} and photometric == _RGB and samples in (3, 4))
    ):
        name = _NAMES.get(photometric, f"photometric interpretation {photometric}")
        raise InputError(
            f"{path}: is {name} of {depth} bits, {samples} samples per pixel; needed: RGB or gray "
            f"of 8 or 16 bits (16-bit gray without transparency). {CONVERT}"
        )
    extra = tags.get(_EXTRA, ())
    if 1 in extra:
        raise InputError(f"{path}: {PREMULTIPLIED}")
    return Layout(
        deep=deep,
        planes=deep and tags.get(_PLANAR) == 2,
        inverted=photometric == _WHITE_IS_ZERO and depth > 8,
        full=2 ** max(8, depth) - 1,
        transfer=_TRANSFER in tags,
        unknown=not {*extra} <= {2, 999},  # opacity; CorelDRAW writes 999
    )


def _directories(path: Path) -> Iterator[Mapping[int, Any]]:
    """Read the tags of a file's directories, one per page."""
    with path.open("rb") as file:
        head = file.read(8)
        head += file.read(8) if head[2] == 43 else b""  # BigTIFF
        directory = TiffImagePlugin.ImageFileDirectory_v2(head)
        visited = {0}
        while directory.next not in visited and len(visited) <= _MAX_DIRECTORIES:
            visited.add(directory.next)
            file.seek(directory.next)
            directory.load(file)
            if tags := {tag: directory[tag] for tag in _TAGS if tag in directory}:
                yield tags


def _is_copy(tags: Mapping[int, Any]) -> bool:
    """Return whether a page is a reduced copy of a different page, or a mask."""
    return bool(tags.get(_SUBFILE, 0) & 5) or tags.get(_OLD_SUBFILE) == 2


def unfit(path: Path | str, kind: str) -> InputError:
    """Return the error for samples of an unsupported type, such as float32."""
    return InputError(
        f"{path}: its samples are {kind}; needed: integers of 8 or 16 bits. Save it again, for "
        "instance as 16-bit TIFF, with the saturation level at full scale."
    )
