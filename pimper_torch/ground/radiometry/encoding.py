"""User-given encoding of the values in photographs' files."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pimper_torch.runtime.config import require

ResponseChoice = Literal["auto", "srgb", "linear"] | float | Path
# A whole number is one of a file's levels.
SaturationChoice = Literal["auto"] | float | tuple[float | int, float | int, float | int]

# Radiance from which a pixel counts as saturated, 1 being the level itself: JPEG moves what was
# 255 down by two levels, which in sRGB are 0.018 of radiance.
SATURATED = 0.98


@dataclass(frozen=True, slots=True, kw_only=True)
class Encoding:
    """Encoding of radiance as the values in the files.

    Levels up to 1 are fractions of the files' full scale, larger ones are in the files' own units:
    0.25 and 16384 are the same in files of 16 bits.

    Attributes:
        response: auto takes what each file says (its ICC profile, PNG's cICP, EXIF),
            sRGB where it is silent; or, whatever they say, srgb; linear; the exponent of a gamma
            curve, such as 2.2; a CSV or NPY file with a measured response curve.
        saturation: Level at which the sensor saturates, one or red, green and blue; auto finds
            it in the photographs, and takes full scale where they show none.
        black: Level that the files hold in the dark.
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
            assert not isinstance(level, str), "auto was seen to above"
            above = level > self.black or (level <= 1 < self.black)
            require(
                0 < level < math.inf and above,
                "saturation",
                self.saturation,
                f"auto, or above 0 and above black ({self.black:g})",
            )


# What files say; what most cameras and programs write; what is proportional to radiance up to full
# scale.
FROM_FILES = Encoding()
SRGB = Encoding(response="srgb")
LINEAR = Encoding(response="linear", saturation=1.0)
