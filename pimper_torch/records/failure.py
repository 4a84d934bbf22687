"""What of a run failed and was left out."""

from dataclasses import dataclass

from pimper_torch.records.record import Record


@dataclass(frozen=True, slots=True, kw_only=True)
class Failure(Record):
    """One patch, view, point or solver that failed, while the rest went on.

    Attributes:
        stage: Where.
        what: ``view``, ``points``, ``patch``, ``solver`` or ``memory``.
        name: Of the view, the system or the work; the facet's number for a patch.
        reason: Why it failed.
        done: What was done in its place.
    """

    stage: str
    what: str
    name: str
    reason: str
    done: str
