"""Factorization beyond the chain's: any low-rank matrix, other orders of light, other solvers.

Problems are :class:`pimper_torch.photometry.Bilinear`, and solvers of one signature: those of
:mod:`pimper_torch.photometry` and :func:`solve_alternation`.
"""

from pimper_torch.single_view.factorization.alternation import solve_alternation
from pimper_torch.single_view.factorization.ambiguity import Ambiguity
from pimper_torch.single_view.factorization.bas_relief import BasRelief
from pimper_torch.single_view.factorization.colour import ColourFactors, solve_in_colour
from pimper_torch.single_view.factorization.low_rank import (
    low_rank_problem,
    random_left,
    singular_left,
)
from pimper_torch.single_view.factorization.manifolds import Free
from pimper_torch.single_view.factorization.restarts import Restarted, factorize_from_many

__all__ = [
    "Ambiguity",
    "BasRelief",
    "ColourFactors",
    "Free",
    "Restarted",
    "factorize_from_many",
    "low_rank_problem",
    "random_left",
    "singular_left",
    "solve_alternation",
    "solve_in_colour",
]
