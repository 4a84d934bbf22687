"""Header of an image file, whichever library reads it, and its focal length by EXIF.

The 35 mm equivalent is that of the recorded picture by EXIF 2.3, digital zoom included, and
telephones write it so: 55 mm at a zoom of 1.951, of a lens of 28 mm. The resolution of the focal
plane never contains it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from PIL import ExifTags

from pimper_torch.doors.io.tiff import Layout
from pimper_torch.ground.radiometry.colour import SILENT, Colour
from pimper_torch.records import Record

# Diagonal of the 36 mm x 24 mm frame, to which CIPA DCG-001 relates the 35 mm equivalent.
_FRAME_DIAGONAL_MM = math.hypot(36, 24)
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # EXIF's FocalPlaneResolutionUnit


def focal_from_exif(tags: Mapping[int, object], width: int, height: int) -> float:
    """Read the focal length of an image of this size from EXIF, in pixels; NaN where it is silent.

    From the 35 mm equivalent, which survives resizing, by the diagonal of the frame; else, or where
    digital zoom was used, from the focal length, the resolution of the focal plane and the zoom,
    corrected for a resize since the camera wrote ``PixelXDimension``. A zoom of 0, 1 or less is
    none.

    >>> focal_from_exif({0xA405: 50}, width=3600, height=2400)
    5000.0
    """
    zoom = max(1.0, positive_number(tags.get(ExifTags.Base.DigitalZoomRatio)))
    focal_mm = positive_number(tags.get(ExifTags.Base.FocalLength))
    equivalent = positive_number(tags.get(ExifTags.Base.FocalLengthIn35mmFilm))
    resolution = positive_number(tags.get(ExifTags.Base.FocalPlaneXResolution))
    unit = tags.get(ExifTags.Base.FocalPlaneResolutionUnit, 2)
    unit_mm = _MM_PER_UNIT.get(unit) if isinstance(unit, int) else None
    has_plane = bool(focal_mm and resolution and unit_mm)
    if equivalent and not (zoom > 1 and has_plane):
        return equivalent / _FRAME_DIAGONAL_MM * math.hypot(width, height)
    if not (has_plane and unit_mm):
        return math.nan
    taken = max(
        positive_number(tags.get(ExifTags.Base.ExifImageWidth)),
        positive_number(tags.get(ExifTags.Base.ExifImageHeight)),
    )
    resized = max(width, height) / taken if taken else 1.0
    return zoom * focal_mm * resolution / unit_mm * resized


def positive_number(value: object) -> float:
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
        width: Pixels, the right way up, as is the height.
        orientation: EXIF's number, 1 to 8; 1 is upright.
        channels: 1 or 3; alpha not counted.
        deep: True for 16-bit samples in several channels, which Pillow would cut to 8.
        full: Level that is full scale, 255 or 65535, or less where a TIFF has other bits.
        full_told: The file itself says what its full scale is.
        cautions: What it says and is not followed, each a sentence without its subject.
        layout: Of a TIFF; ``None`` for other files.
    """

    width: int
    height: int
    orientation: int
    focal_px: float
    channels: int
    deep: bool
    full: int = 255
    full_scale_given: bool = False
    colour: Colour = SILENT
    cautions: tuple[str, ...] = ()
    layout: Layout | None = None
