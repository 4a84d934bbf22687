"""The factor from a result's own unit to a known one, and how well its sources agree."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Literal, get_args

from pimper_torch.doors.scale.given import Unit
from pimper_torch.records import Record
from pimper_torch.runtime.errors import InputError, caution

Source = Literal["scale bars", "markers", "camera distances"]
# From the most accurate to the least: two places that a person clicked on the surface; printed
# corners, whose paper may be wavy; cameras, whose centres nobody can touch.
_SOURCES: tuple[Source, ...] = get_args(Source)

AGREEING = 0.02
"""Relative difference of lengths up to which they do not contradict one another. A choice: a
ruler's millimetre in five centimetres."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scale(Record):
    """Factor that brings lengths to a known unit.

    Attributes:
        factor: Of a result in its own unit.
        residual: Root mean square of what single lengths are off, as a fraction of each; NaN where
            there is one length only.
    """

    factor: float
    unit: Unit
    source: Source
    residual: float
    count: int

    def report(self) -> dict[str, object]:
        """Return the entry ``scale`` of ``summary.json``."""
        return asdict(self) | {"residual": None if math.isnan(self.residual) else self.residual}


@dataclass(frozen=True, slots=True, kw_only=True)
class Length(Record):
    """A distance in a result, and how long it is.

    Attributes:
        found: In the result's unit.
        known: In the unit wanted.
    """

    found: float
    known: float
    what: str


def fitted(lengths: Sequence[Length], unit: Unit, source: Source) -> Scale:
    r"""Find the factor by least squares, :math:`\min_f \sum (f d - L)^2`.

    A warning names lengths that contradict one another by more than :data:`AGREEING`.
    """
    for length in lengths:
        if not (length.found > 0 and length.known > 0):
            raise InputError(
                f"{length.what}: is {length.found:g} in the result and {length.known:g} {unit} in "
                "truth; needed: two places apart, and a length above 0."
            )
    factor = sum(one.known * one.found for one in lengths) / sum(one.found**2 for one in lengths)
    off = [factor * one.found / one.known - 1 for one in lengths]
    alone = len(lengths) == 1
    residual = math.nan if alone else math.sqrt(sum(one**2 for one in off) / len(off))
    if max(map(abs, off)) > AGREEING:
        told = "; ".join(
            f"{one.what} is {factor * one.found:.4g} {unit} instead of {one.known:.4g} ({by:+.1%})"
            for one, by in zip(lengths, off, strict=True)
        )
        caution(
            f"The {source} contradict one another by more than {AGREEING:.0%}: {told}. The size is "
            "that of least squares. Measure again what is farthest off, or leave it out.",
            stacklevel=2,
        )
    return Scale(factor=factor, unit=unit, source=source, residual=residual, count=len(lengths))


def most_accurate(scales: Sequence[Scale]) -> Scale | None:
    """Take the most accurate of several scales; warn where others contradict it.

    Scale bars come before markers, and markers before camera distances.

    Args:
        scales: Of one result, one a source, in one unit.
    """
    if not scales:
        return None
    best, *others = sorted(scales, key=lambda scale: _SOURCES.index(scale.source))
    for other in others:
        off = other.factor / best.factor - 1
        if abs(off) > AGREEING:
            caution(
                f"The {best.source} and the {other.source} give sizes that differ by {off:+.1%}. "
                f"Taken are the {best.source}. Check the other lengths and their unit, and whether "
                "a printer scaled the markers.",
                stacklevel=2,
            )
    return best
