"""Failures of a run, and the parts that it left out."""

from dataclasses import dataclass
from typing import Literal

from pimper_torch.records.record import Record

What = Literal["photographs", "features", "matches", "points", "pixels", "facets", "faces", "doubt"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Failure(Record):
    """One patch, view, point or solver that failed, while the rest went on.

    Attributes:
        what: ``view``, ``points``, ``patch`` or ``solver``.
        name: Of the view, the system or the work; the facet's number for a patch.
        done: What was done in its place.
    """

    stage: str
    what: str
    name: str
    reason: str
    done: str


@dataclass(frozen=True, slots=True, kw_only=True)
class LeftOut(Record):
    """Items that a guard left out or doubted; see :mod:`pimper_torch.runtime.ledger`.

    Attributes:
        guard: Room and name, such as ``extract.borders``.
        what: Was left out; samples of photographs are pixels.
        names: Of photographs, where they are known.
    """

    guard: str
    what: What
    count: int
    total: int
    reason: str
    names: tuple[str, ...] = ()
