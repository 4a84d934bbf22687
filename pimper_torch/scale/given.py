"""Lengths given by the user; needs neither torch nor photographs."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from pimper_torch.runtime.config import require
from pimper_torch.runtime.errors import InputError

Unit = Literal["mm", "cm", "m", "in"]
"""Units of length for results."""

MILLIMETRES: dict[Unit, float] = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}

_NUMBER = r"\s*[-+]?(?:\d+\.?\d*|\.\d+)\s*"
_POINTER = re.compile(rf"(?P<name>.+?),(?P<x>{_NUMBER}),(?P<y>{_NUMBER})(?:\+|$)")


@dataclass(frozen=True, slots=True, kw_only=True)
class PixelMark:
    """A pixel of a photograph.

    Attributes:
        name: Name of the photograph, with or without its suffix.
        x: Pixels to the right from the corner of the top-left pixel, whose centre is (0.5, 0.5).
        y: Pixels down from that corner.
        size_px: Width and height of the upright photograph to which the pixel refers; ``None``
            for the size in which it was loaded.
    """

    name: str
    x: float
    y: float
    size_px: tuple[int, int] | None = None

    def __str__(self) -> str:
        return f"{self.name},{self.x:g},{self.y:g}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """A point in space, marked in one or more photographs.

    Attributes:
        pointers: A single pixel marks a point on the surface; two or more are triangulated.
    """

    pointers: tuple[PixelMark, ...]

    @classmethod
    def read(cls, text: str) -> "Mark":
        """Parse ``NAME,x,y``, or several of these joined by ``+``.

        >>> Mark.read("a, b.jpg,10,20.5").pointers
        (PixelMark(name='a, b.jpg', x=10.0, y=20.5, size_px=None),)
        >>> str(Mark.read("1+1.jpg,10,20+c,7,8"))
        '1+1.jpg,10,20+c,7,8'
        """
        pointers, start = [], 0
        while match := _POINTER.match(text, start):
            pointers.append(PixelMark(name=match["name"], x=float(match["x"]), y=float(match["y"])))
            start = match.end()
        if not pointers or start < len(text) or text.endswith("+"):
            raise InputError(
                f"{text!r} is not a pixel of a photograph; needed: NAME,x,y, in pixels to the "
                "right and down from the top-left corner, such as IMG_1.jpg,1200,831.5."
            )
        return cls(pointers=tuple(pointers))

    def __str__(self) -> str:
        return "+".join(map(str, self.pointers))


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleBar:
    """Two points and the distance between them.

    Attributes:
        length: Distance between them, in the unit of the scale.
    """

    first: Mark
    second: Mark
    length: float

    def __post_init__(self) -> None:
        _require_length(self.length, f"{self.first} to {self.second}")

    @classmethod
    def read(cls, first: str, second: str, length: str) -> "ScaleBar":
        """Parse two marks and a length."""
        return cls(first=Mark.read(first), second=Mark.read(second), length=float(length))

    @property
    def ends(self) -> tuple[Mark, Mark]:
        """Both end points."""
        return self.first, self.second


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraDistance:
    """Two photographs and the distance between their cameras.

    Attributes:
        first: Name of a photograph, with or without its suffix.
        length: Distance between the centres of projection, in the unit of the scale.
    """

    first: str
    second: str
    length: float

    def __post_init__(self) -> None:
        _require_length(self.length, f"{self.first} to {self.second}")

    @classmethod
    def read(cls, first: str, second: str, length: str) -> "CameraDistance":
        """Parse two names and a length."""
        return cls(first=first, second=second, length=float(length))


def measured_in(bars: Sequence[ScaleBar], distances: Sequence[CameraDistance]) -> dict[str, None]:
    """List the names of photographs in lengths, as given and without duplicates."""
    named = [pointer.name for bar in bars for mark in bar.ends for pointer in mark.pointers]
    return dict.fromkeys(named + [name for pair in distances for name in (pair.first, pair.second)])


def require_inside(pointer: PixelMark, width: int, height: int) -> None:
    """Raise an error if a pixel is outside its photograph."""
    if not (0 <= pointer.x <= width and 0 <= pointer.y <= height):
        raise InputError(
            f"{pointer}: is outside the photograph, which has {width} x {height} pixels; needed: "
            "pixels to the right and down from the top-left corner of the upright photograph."
        )


def _require_length(length: float, what: str) -> None:
    require(0 < length < float("inf"), f"the length of {what}", length, "above 0 and finite")
