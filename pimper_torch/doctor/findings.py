"""Findings: the measurement, the requirement, and the advice."""

from dataclasses import dataclass
from typing import Literal

Severity = Literal["ok", "note", "warning", "error"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Result of one check.

    Attributes:
        severity: ok; a note, which may be meant; a warning, where the result will suffer; or an
            error, with which a run is refused.
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


def ok(check: str, found: str) -> Finding:
    """Return what a check found where all is well."""
    return Finding(check=check, severity="ok", found=found)


def warned(
    check: str, found: str, needed: str, advice: str, severity: Severity = "warning"
) -> Finding:
    """Return what a check found where something is to be done."""
    return Finding(check=check, severity=severity, found=found, needed=needed, advice=advice)
