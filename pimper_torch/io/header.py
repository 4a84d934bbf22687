"""Header of an image file, whichever library reads it, and its focal length by EXIF.

The 35 mm equivalent is that of the recorded picture by EXIF 2.3, digital zoom included, and
telephones write it so: 55 mm at a zoom of 1.951, of a lens of 28 mm. Some cameras leave the zoom
out. One file does not tell which; two files of one lens do, if their zooms differ and their
equivalents do not. The resolution of the focal plane never contains it.
"""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from PIL import ExifTags

from pimper_torch.io.tiff import Layout
from pimper_torch.radiometry.colour import SILENT, Colour
from pimper_torch.records import Record

# Diagonal of the 36 mm x 24 mm frame, to which CIPA DCG-001 relates the 35 mm equivalent.
_FRAME_DIAGONAL_MM = math.hypot(36, 24)
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # EXIF's FocalPlaneResolutionUnit


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class FocalLength(Record):
    """A focal length as one file tells it.

    Attributes:
        px: NaN where the file is silent.
        lens: Focal length and 35 mm equivalent in mm, 0 where absent.
        zoom: Digital zoom that ``px`` contains only if the equivalent does; else 1.
    """

    px: float = math.nan
    lens: tuple[float, float] = (0.0, 0.0)
    zoom: float = 1.0


def focal_from_exif(tags: Mapping[int, object], width: int, height: int) -> FocalLength:
    """Read the focal length of an image of this size from EXIF.

    From the 35 mm equivalent, which survives resizing, by the diagonal of the frame; else, or where
    digital zoom was used, from the focal length, the resolution of the focal plane and the zoom,
    corrected for a resize since the camera wrote ``PixelXDimension``. A zoom of 0, 1 or less is
    none.

    >>> focal_from_exif({0xA405: 50}, width=3600, height=2400).px
    5000.0
    """
    zoom = max(1.0, _positive(tags.get(ExifTags.Base.DigitalZoomRatio)))
    focal_mm = _positive(tags.get(ExifTags.Base.FocalLength))
    equivalent = _positive(tags.get(ExifTags.Base.FocalLengthIn35mmFilm))
    resolution = _positive(tags.get(ExifTags.Base.FocalPlaneXResolution))
    unit = tags.get(ExifTags.Base.FocalPlaneResolutionUnit, 2)
    unit_mm = _MM_PER_UNIT.get(unit) if isinstance(unit, int) else None
    lens = focal_mm, equivalent
    has_plane = bool(focal_mm and resolution and unit_mm)
    if equivalent and not (zoom > 1 and has_plane):
        px = equivalent / _FRAME_DIAGONAL_MM * math.hypot(width, height)
        return FocalLength(px=px, lens=lens, zoom=zoom)
    if not (has_plane and unit_mm):
        return FocalLength(lens=lens)
    taken = max(
        _positive(tags.get(ExifTags.Base.ExifImageWidth)),
        _positive(tags.get(ExifTags.Base.ExifImageHeight)),
    )
    resized = max(width, height) / taken if taken else 1.0
    return FocalLength(px=zoom * focal_mm * resolution / unit_mm * resized, lens=lens)


def focals_px(focals: Sequence[FocalLength]) -> list[float]:
    """Compute focal lengths of one set of photographs in pixels, NaN where a file is silent.

    Where photographs of one lens have the same 35 mm equivalent at unlike digital zooms, the
    equivalent does not contain the zoom, or is rounded: focal lengths are as their zooms then.
    """
    zooms: dict[tuple[float, float], list[float]] = defaultdict(list)
    for focal in focals:
        zooms[focal.lens].append(focal.zoom)
    contained = {}
    for lens, several in zooms.items():
        least, most = min(several), max(several)
        # Of whole millimetres: at 13, zooms nearer to each other may have the same equivalent.
        contained[lens] = math.sqrt(least * most) if most < 1.08 * least else 1.0
    return [focal.px * focal.zoom / contained[focal.lens] for focal in focals]


def _positive(value: object) -> float:
    """Read a number of EXIF; 0 where it is absent, zero, infinite or nonsense."""
    try:
        number = float(value)  # type: ignore[arg-type]  # anything may stand in a file
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return number if 0 < number < math.inf else 0.0


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Header(Record):
    """Metadata of an image file, read without decoding.

    Attributes:
        width: Pixels, the right way up.
        height: Pixels, the right way up.
        orientation: EXIF's number, 1 to 8; 1 is upright.
        channels: 1 or 3; alpha not counted.
        deep: True for 16-bit samples in several channels, which Pillow would cut to 8.
        full: Level that is full scale, 255 or 65535, or less where a TIFF has other bits.
        full_told: The file itself says what its full scale is.
        transparent: Levels of the one colour of 16 bits that a PNG calls transparent.
        cautions: What it says and is not followed, each a sentence without its subject.
        layout: Of a TIFF; ``None`` for other files.
    """

    width: int
    height: int
    orientation: int
    focal: FocalLength
    channels: int
    deep: bool
    full: int = 255
    full_told: bool = False
    transparent: tuple[int, ...] = ()
    colour: Colour = SILENT
    cautions: tuple[str, ...] = ()
    layout: Layout | None = None
