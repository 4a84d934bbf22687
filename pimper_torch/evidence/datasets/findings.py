"""The report of a check of a capture."""

from dataclasses import dataclass

from pimper_torch.records import Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Finding(Record):
    """A mistake.

    Attributes:
        name: Short, for programs.
        meaning: What is wrong.
        remedy: What to do about it.
        evidence: Scores, by measure.
        alternatives: Other mistakes with about the same scores.
    """

    name: str
    meaning: str
    remedy: str
    evidence: dict[str, float]
    alternatives: tuple[str, ...] = ()

    def __str__(self) -> str:
        figures = ", ".join(f"{what} {value:.2g}" for what, value in self.evidence.items())
        alternatives = f" Or else: {', '.join(self.alternatives)}." if self.alternatives else ""
        return f"{self.name}: {self.meaning} ({figures}). To do: {self.remedy}.{alternatives}"


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Comparison(Record):
    """The score of each hypothesis by one measure.

    Attributes:
        evidence: Which.
        hypotheses: The capture as given, then with each mistake undone.
        scores: One a hypothesis; higher is better, 1 is perfect.
    """

    evidence: str
    hypotheses: tuple[str, ...]
    scores: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class CheckReport(Record):
    """The outcome of a check.

    Attributes:
        findings: Mistakes; none if all is consistent.
        comparisons: What was tested. A capture with none could not be tested at all.
    """

    findings: tuple[Finding, ...]
    comparisons: tuple[Comparison, ...]

    def __str__(self) -> str:
        tested = ", ".join(comparison.evidence for comparison in self.comparisons)
        if not self.findings:
            return f"no mistake found; tested: {tested or 'nothing, for want of data'}."
        return "the capture contradicts itself. " + " ".join(str(one) for one in self.findings)
