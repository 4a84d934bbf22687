"""Findings: the measurement, the requirement, and the advice."""

from dataclasses import dataclass
from typing import Literal

Severity = Literal["ok", "note", "warning"]


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check.

    Attributes:
        severity: ok; a note, which may be meant; or a warning, where the result will suffer.
        needed: What there should be; empty where all is well.
        advice: What to do; empty where all is well.
    """

    check: str
    severity: Severity
    found: str
    needed: str = ""
    advice: str = ""

    def __str__(self) -> str:
        needed = f"; needed: {self.needed}" if self.needed else ""
        advice = f" {self.advice}" if self.advice else ""
        return f"{self.found}{needed}.{advice}"
