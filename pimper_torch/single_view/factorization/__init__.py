"""Factorization beyond the chain's: any low-rank matrix, other orders of light.

Problems and solvers are those of :mod:`pimper_torch.photometry`.
"""

from pimper_torch.single_view.factorization.ambiguity import Ambiguity
from pimper_torch.single_view.factorization.bas_relief import BasRelief
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
    "Free",
    "Restarted",
    "factorize_from_many",
    "low_rank_problem",
    "random_left",
    "singular_left",
]
