"""What was found, what was needed, and what to do."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Severity = Literal["ok", "note", "warning", "error"]
_NAMED = 4  # photographs in a sentence


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """What one check found.

    Attributes:
        check: Its name.
        severity: ok; a note, which may be meant; a warning, where the result will suffer; or an
            error, with which a run is refused.
        found: What there is.
        needed: What there should be; empty where all is well.
        advice: What to do; empty where all is well.
    """

    check: str
    severity: Severity
    found: str
    needed: str = ""
    advice: str = ""

    def __str__(self) -> str:
        """State it in a sentence or two."""
        needed = f"; needed: {self.needed}" if self.needed else ""
        advice = f" {self.advice}" if self.advice else ""
        return f"{self.found}{needed}.{advice}"


def listed(names: Sequence[str], at_most: int = _NAMED) -> str:
    """Name a few of many.

    >>> listed(["a", "b", "c"], at_most=2)
    'a, b and 1 more'
    """
    more = len(names) - at_most
    return ", ".join(names[:at_most]) + (f" and {more} more" if more > 0 else "")
