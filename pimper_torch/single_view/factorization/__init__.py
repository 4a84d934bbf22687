"""Factorization of any low-rank matrix, and with other orders of light than in the chains.

Problems and solvers are those of :mod:`pimper_torch.stages.photometry`.
"""

from pimper_torch.single_view.factorization.ambiguity import Ambiguity
from pimper_torch.single_view.factorization.bas_relief import BasRelief
from pimper_torch.single_view.factorization.low_rank import (
    FreeManifold,
    RestartResult,
    factorize_from_many,
    low_rank_problem,
    random_left,
    singular_left,
)

__all__ = [
    "Ambiguity",
    "BasRelief",
    "FreeManifold",
    "RestartResult",
    "factorize_from_many",
    "low_rank_problem",
    "random_left",
    "singular_left",
]
