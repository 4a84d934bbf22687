"""Header of an image file, independent of its reader, and its focal length by EXIF.

By EXIF 2.3 the 35 mm equivalent is that of the recorded image, including digital zoom, as phones
write it: 55 mm at a zoom of 1.951, for a lens of 28 mm. The resolution of the focal plane never
includes zoom.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from PIL import ExifTags

from pimper_torch.io.tiff import Layout
from pimper_torch.radiometry.colour import SILENT, Colour
from pimper_torch.records import Record

# Diagonal of the 36 mm x 24 mm frame, the reference of the 35 mm equivalent in CIPA DCG-001.
_FRAME_DIAGONAL_MM = math.hypot(36, 24)
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # EXIF's FocalPlaneResolutionUnit


def focal_from_exif(tags: Mapping[int, object], width: int, height: int) -> float:
    """Return the focal length in pixels of an image of this size, by EXIF; NaN if unknown.

    It follows from the 35 mm equivalent, which survives resizing, and the diagonal of the frame;
    else, or with digital zoom, from the focal length, the resolution of the focal plane and the
    zoom, corrected for a resize since the camera wrote ``PixelXDimension``. A zoom of at most 1
    is ignored.

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
    recorded = max(
        positive_number(tags.get(ExifTags.Base.ExifImageWidth)),
        positive_number(tags.get(ExifTags.Base.ExifImageHeight)),
    )
    resized = max(width, height) / recorded if recorded else 1.0
    return zoom * focal_mm * resolution / unit_mm * resized


def positive_number(value: object) -> float:
    """Return a number of EXIF; 0 if it is missing, not positive, infinite or invalid."""
    try:
        number = float(value)  # type: ignore[arg-type]  # a file may contain anything
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return number if 0 < number < math.inf else 0.0


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Header(Record):
    """Metadata of an image file, read without decoding.

    Attributes:
        width: Width in pixels of the upright image; likewise the height.
        orientation: EXIF orientation, 1 to 8; 1 is upright.
        channels: 1 or 3, without alpha.
        deep: True for 16-bit samples in several channels, which Pillow would truncate to 8 bits.
        full: Full-scale level, 255 or 65535, or less for a TIFF of a different bit depth.
        full_scale_given: Whether the file states its full scale.
        cautions: Metadata that are not applied, each a sentence without its subject.
        layout: Layout of a TIFF; ``None`` for other files.
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
