"""Lengths that a person gives; needs neither torch nor photographs."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from pimper_torch.runtime.config import require
from pimper_torch.runtime.errors import InputError, some

Unit = Literal["mm", "cm", "m", "in"]
"""Units of length that results may have."""

MILLIMETRES: dict[Unit, float] = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}

_NUMBER = r"\s*[-+]?(?:\d+\.?\d*|\.\d+)\s*"
_POINTER = re.compile(rf"(?P<name>.+?),(?P<x>{_NUMBER}),(?P<y>{_NUMBER})(?:\+|$)")


@dataclass(frozen=True, slots=True, kw_only=True)
class PixelMark:
    """A pixel of a photograph that shows a place.

    Attributes:
        name: Of the photograph, with its suffix or without.
        x: Pixels to the right from the corner of the top-left pixel, whose centre is (0.5, 0.5).
        y: Pixels down from it.
        size_px: Width and height of the photograph that the pixels are of, the right way up;
            ``None`` for the size that it was loaded in.
    """

    name: str
    x: float
    y: float
    size_px: tuple[int, int] | None = None

    def __str__(self) -> str:
        return f"{self.name},{self.x:g},{self.y:g}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """One place, pointed at in one photograph or more.

    Attributes:
        pointers: One alone shows a place on the surface; from two on, it may be anywhere.
    """

    pointers: tuple[PixelMark, ...]

    @classmethod
    def read(cls, text: str) -> "Mark":
        """Read ``NAME,x,y``, or several of them with ``+`` between.

        >>> Mark.read("a, b.jpg,10,20.5").pointers
        (Pointer(name='a, b.jpg', x=10.0, y=20.5, size_px=None),)
        >>> str(Mark.read("1+1.jpg,10,20+c,7,8"))
        '1+1.jpg,10,20+c,7,8'
        """
        found, at = [], 0
        while match := _POINTER.match(text, at):
            found.append(PixelMark(name=match["name"], x=float(match["x"]), y=float(match["y"])))
            at = match.end()
        if not found or at < len(text) or text.endswith("+"):
            raise InputError(
                f"{text!r} is no place in a photograph; needed: NAME,x,y, pixels to the right and "
                "down from the top-left corner, such as IMG_1.jpg,1200,831.5."
            )
        return cls(pointers=tuple(found))

    def __str__(self) -> str:
        return "+".join(map(str, self.pointers))


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleBar:
    """Two places, and how far apart they are.

    Attributes:
        length: Between them, in the unit wanted.
    """

    first: Mark
    second: Mark
    length: float

    def __post_init__(self) -> None:
        _require_length(self.length, f"{self.first} to {self.second}")

    @property
    def ends(self) -> tuple[Mark, Mark]:
        """Both ends."""
        return self.first, self.second


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraDistance:
    """Two photographs, and how far apart their cameras stood.

    Attributes:
        first: Name of a photograph, with its suffix or without.
        length: Between the centres of projection, in the unit wanted.
    """

    first: str
    second: str
    length: float

    def __post_init__(self) -> None:
        _require_length(self.length, f"{self.first} to {self.second}")


def measured_in(bars: Sequence[ScaleBar], distances: Sequence[CameraDistance]) -> dict[str, None]:
    """List the photographs that lengths name, each once, as they are named."""
    named = [pointer.name for bar in bars for mark in bar.ends for pointer in mark.pointers]
    return dict.fromkeys(named + [name for one in distances for name in (one.first, one.second)])


def number_of(name: str, names: Sequence[str]) -> int:
    """Find the photograph of a name, with its suffix or without.

    Args:
        names: Of all photographs, different from one another.

    >>> number_of("b", ["a.jpg", "b.jpg"])
    1
    """
    exact = [index for index, known in enumerate(names) if name == known]
    stems = [index for index, known in enumerate(names) if name == known.rpartition(".")[0]]
    found = exact or stems
    if len(found) != 1:
        raise InputError(
            f"{name!r}: {len(found) or 'none'} of the photographs {'are' if found else 'is'} "
            f"named so; needed: one of {some(names)}."
        )
    return found[0]


def require_inside(pointer: PixelMark, width: int, height: int) -> None:
    """Refuse a pixel outside of its photograph."""
    if not (0 <= pointer.x <= width and 0 <= pointer.y <= height):
        raise InputError(
            f"{pointer}: lies outside of the photograph, which has {width} x {height} pixels; "
            "needed: pixels to the right and down from its top-left corner, the right way up."
        )


def _require_length(length: float, what: str) -> None:
    require(0 < length < float("inf"), f"the length of {what}", length, "above 0 and finite")
