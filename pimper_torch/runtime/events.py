"""Events of a run, which :mod:`~pimper_torch.runtime.stream` passes to listeners.

The result of a run lists failures, removals by guards, and reports of stages.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeVar

AnyEvent = TypeVar("AnyEvent", bound="Event")

What = Literal[
    "photographs", "features", "matches", "points", "pixels", "facets", "faces", "warning"
]


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """Frozen description of something that happened during a run."""

    def replace(self: AnyEvent, **changes: object) -> AnyEvent:
        """Return a copy with some fields changed."""
        return dataclasses.replace(self, **changes)


@dataclass(frozen=True, slots=True, kw_only=True)
class Caution(Event):
    """A warning about a result that is returned anyway."""

    message: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Failure(Event):
    """One patch, view, point or solver that failed while the run continued.

    Attributes:
        what: ``view``, ``points``, ``patch`` or ``solver``.
        name: Name of the view, system or task; the facet's number for a patch.
        done: What was done instead.
    """

    stage: str
    what: str
    name: str
    reason: str
    done: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Removal(Event):
    """Items that a guard removed or reported; see :mod:`pimper_torch.runtime.ledger`.

    Attributes:
        guard: Stage and name, such as ``extract.borders``.
        what: Kind of the items; samples of photographs are pixels.
        names: Names of the photographs, if known.
    """

    guard: str
    what: What
    count: int
    total: int
    reason: str
    names: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress(Event):
    """Number of finished steps of a stage, and of all its steps."""

    done: int
    total: int


@dataclass(frozen=True, slots=True, kw_only=True)
class StageStarted(Event):
    """The start of a stage, which its report follows unless it fails."""

    name: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Counts(Event):
    """Counts to add to the figures of the running stage."""

    counts: Mapping[str, int | float]


@dataclass(frozen=True, slots=True, kw_only=True)
class StageReport(Event):
    """Cost and figures of one stage.

    Attributes:
        peak_memory_mb: Highest resident memory of the process up to the stage's end.
        figures: Counts and fractions, such as ``samples`` or ``missing_samples``.
        kept: Whether the record is an earlier run's; time and memory are then that run's.
    """

    name: str
    seconds: float
    peak_memory_mb: float
    figures: dict[str, int | float]
    kept: bool = False
