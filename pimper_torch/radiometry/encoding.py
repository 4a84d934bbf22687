"""User-given encoding of the values in the files of photographs."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pimper_torch.runtime.config import require

ResponseChoice = Literal["auto", "srgb", "linear"] | float | Path
# Integers are levels of the file.
SaturationChoice = Literal["auto"] | float | tuple[float | int, float | int, float | int]

# Radiance at which a pixel counts as saturated, as a fraction of the saturation level: JPEG may
# lower 255 by two levels, 0.018 of radiance in sRGB.
SATURATED = 0.98


@dataclass(frozen=True, slots=True, kw_only=True)
class Encoding:
    """Encoding of radiance as the values in the files.

    Levels up to 1 are fractions of the files' full scale, larger ones are in the files' own units:
    0.25 and 16384 are the same in files of 16 bits.

    Attributes:
        response: auto uses the declaration of each file (its ICC profile, PNG's cICP, EXIF), or
            sRGB without one. These override it: srgb; linear; the exponent of a gamma curve, such
            as 2.2; a CSV or NPY file with a measured response curve.
        saturation: Level at which the sensor saturates, one for all colours or red, green and blue;
            auto estimates it from the photographs, or uses full scale if nothing is saturated.
        black: Level of the files in the dark.
    """

    response: ResponseChoice = "auto"
    saturation: SaturationChoice = "auto"
    black: float = 0.0

    def __post_init__(self) -> None:
        if isinstance(self.response, float):
            usual = 0.1 <= self.response <= 10
            require(usual, "response", self.response, "auto, srgb, linear, a file, or 0.1 to 10")
        require(0 <= self.black < math.inf, "black", self.black, "0 or more")
        if self.saturation == "auto":
            return
        given = self.saturation if isinstance(self.saturation, tuple) else (self.saturation,)
        for level in given:
            assert not isinstance(level, str), "auto returns above"
            above = level > self.black or (level <= 1 < self.black)
            require(
                0 < level < math.inf and above,
                "saturation",
                self.saturation,
                f"auto, or above 0 and above black ({self.black:g})",
            )


# Declared by files; of most cameras and programs; proportional to radiance up to full scale.
FROM_FILES = Encoding()
SRGB = Encoding(response="srgb")
LINEAR = Encoding(response="linear", saturation=1.0)
