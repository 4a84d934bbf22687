"""Header of an image file, whichever library reads it."""

from dataclasses import dataclass

from pimper_torch.io.focal_lengths import FocalLength
from pimper_torch.io.tiff import Layout
from pimper_torch.radiometry.colour import SILENT, Colour
from pimper_torch.records import Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Header(Record):
    """Metadata of an image file, read without decoding.

    Attributes:
        width: Pixels, the right way up.
        height: Pixels, the right way up.
        orientation: EXIF's number, 1 to 8; 1 is upright.
        focal: See :mod:`pimper_torch.io.focal_lengths`.
        channels: 1 or 3; alpha not counted.
        deep: True for 16-bit samples in several channels, which Pillow would cut to 8.
        full: Level that is full scale, 255 or 65535, or less of 16 bits where a TIFF says so.
        full_told: The file itself says what its full scale is.
        significant: Bits of 16 that a PNG says are no filling; 16 where it is silent.
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
    significant: int = 16
    transparent: tuple[int, ...] = ()
    colour: Colour = SILENT
    cautions: tuple[str, ...] = ()
    layout: Layout | None = None
