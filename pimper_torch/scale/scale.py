"""Factor from scene units to a known unit, and how well its sources agree."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Literal, get_args

from pimper_torch.records import Record
from pimper_torch.runtime.errors import InputError, caution
from pimper_torch.scale.given import Unit

Source = Literal["scale bars", "markers", "camera distances"]
# From most to least accurate: two points clicked on the surface; printed corners, on paper that may
# be wavy; centres of cameras, which no ruler can reach.
_SOURCES: tuple[Source, ...] = get_args(Source)

AGREEING = 0.02
"""Largest relative difference between consistent lengths. A choice: a ruler's millimetre in five
centimetres."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scale(Record):
    """Factor from scene units to a known unit.

    Attributes:
        factor: Multiplies lengths in scene units.
        residual: Root mean square of the relative errors of the lengths; NaN for a single length.
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
    """A distance in a result, and its true length.

    Attributes:
        measured: In scene units.
        true: In the unit of the scale.
        label: Name of the distance in messages.
    """

    measured: float
    true: float
    label: str


def fit_scale(lengths: Sequence[Length], unit: Unit, source: Source) -> Scale:
    r"""Fit the scale by least squares, :math:`\min_f \sum (f d - L)^2`.

    A warning names lengths that contradict each other by more than :data:`AGREEING`.
    """
    for length in lengths:
        if not (length.measured > 0 and length.true > 0):
            raise InputError(
                f"{length.label}: is {length.measured:g} in the result, and {length.true:g} {unit} "
                "is given; needed: two different points, and a length above 0."
            )
    squares = sum(length.measured**2 for length in lengths)
    factor = sum(length.true * length.measured for length in lengths) / squares
    errors = [factor * length.measured / length.true - 1 for length in lengths]
    single = len(lengths) == 1
    residual = math.nan if single else math.sqrt(sum(error**2 for error in errors) / len(errors))
    if max(map(abs, errors)) > AGREEING:
        rows = "; ".join(
            f"{d.label} is {factor * d.measured:.4g} {unit} instead of {d.true:.4g} ({error:+.1%})"
            for d, error in zip(lengths, errors, strict=True)
        )
        caution(
            f"The {source} contradict each other by more than {AGREEING:.0%}: {rows}. The scale is "
            "their least-squares fit. Measure the one with the largest error again, or remove it.",
            stacklevel=2,
        )
    return Scale(factor=factor, unit=unit, source=source, residual=residual, count=len(lengths))


def most_accurate(scales: Sequence[Scale]) -> Scale | None:
    """Return the scale from the most accurate source, and warn if others contradict it.

    Scale bars are preferred to markers, and markers to camera distances.

    Args:
        scales: Scales of the same result in the same unit, one per source.
    """
    if not scales:
        return None
    best, *others = sorted(scales, key=lambda scale: _SOURCES.index(scale.source))
    for other in others:
        difference = other.factor / best.factor - 1
        if abs(difference) > AGREEING:
            caution(
                f"The {best.source} and the {other.source} give scales that differ by "
                f"{difference:+.1%}. The {best.source} are used. Check the other lengths and their "
                "unit, and whether the printer scaled the markers.",
                stacklevel=2,
            )
    return best
