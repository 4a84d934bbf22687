"""The terms of the fusion with their equations, built in the order that :class:`Term` states."""

from dataclasses import dataclass

import torch
from torch import Tensor

from pimper_torch.records.shapes import PerVertex
from pimper_torch.runtime.memory import release_memory
from pimper_torch.stages.fusion.blocks import Key
from pimper_torch.stages.fusion.equations import Equations
from pimper_torch.stages.fusion.problem import Problem
from pimper_torch.stages.fusion.terms import KnownVertices, Normals, Term


@dataclass(frozen=True, slots=True)
class Assembly:
    """Terms, each with its equations for one problem."""

    problem: Problem
    parts: tuple[tuple[Term, list[Equations]], ...]

    @classmethod
    def of(cls, terms: tuple[Term, ...], problem: Problem) -> "Assembly":
        """Assemble the equations of all terms, with the edges whose slope any of them determines.

        Terms of points share a ray caster, which is freed after that.
        """
        problem = _sloped(problem, terms)
        parts = tuple((term, term.equations(problem)) for term in terms)
        release_memory()
        return cls(problem, parts)

    @property
    def terms(self) -> tuple[Term, ...]:
        """The terms without their equations."""
        return tuple(term for term, _ in self.parts)

    @property
    def equations(self) -> list[Equations]:
        """The equations of all terms."""
        return [kind for _, kinds in self.parts for kind in kinds]

    @property
    def keys(self) -> list[Key]:
        """Indices of every kind: that of its term, and its own within the term."""
        parts = enumerate(self.parts)
        return [(index, kind) for index, (_, kinds) in parts for kind in range(len(kinds))]

    def of_ranks(self, least: int, most: int) -> "Assembly":
        """Return the terms in a range of ranks."""
        parts = tuple(part for part in self.parts if least <= part[0].rank <= most)
        return Assembly(self.problem, parts)

    def with_normals(self, **changes: Tensor) -> "Assembly":
        """Return the terms for other photometric normals, or another variance of their tilt."""
        problem = self.problem.replace(**changes)
        parts = (
            (term, term.equations(problem) if isinstance(term, Normals) else kinds)
            for term, kinds in self.parts
        )
        return Assembly(problem, tuple(parts))

    def reestimate(self, heights: PerVertex, trusted: KnownVertices, rank: int) -> "Assembly":
        """Return the terms, with common errors of those above a rank estimated from the heights."""
        terms = tuple(
            term.reestimate(self.problem, heights, trusted) if kinds and term.rank > rank else term
            for term, kinds in self.parts
        )
        if not torch.equal(_sloped(self.problem, terms).sloped, self.problem.sloped):
            return Assembly.of(terms, self.problem)
        parts = (
            (new, kinds if new is old else new.equations(self.problem))
            for new, (old, kinds) in zip(terms, self.parts, strict=True)
        )
        return Assembly(self.problem, tuple(parts))


def _sloped(problem: Problem, terms: tuple[Term, ...]) -> Problem:
    masks = [torch.zeros_like(problem.lit), *(term.sloped(problem) for term in terms)]
    return problem.replace(sloped=torch.stack(masks).any(dim=0))
