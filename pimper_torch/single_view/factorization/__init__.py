"""Factorization of any low-rank matrix, and with other orders of light than in the chains.

Problems and solvers are those of :mod:`pimper_torch.stages.photometry`.
"""

from pimper_torch.single_view.factorization.ambiguity import Ambiguity as Ambiguity
from pimper_torch.single_view.factorization.bas_relief import BasRelief as BasRelief
from pimper_torch.single_view.factorization.low_rank import FreeManifold as FreeManifold
from pimper_torch.single_view.factorization.low_rank import RestartResult as RestartResult
from pimper_torch.single_view.factorization.low_rank import (
    factorize_from_many as factorize_from_many,
)
from pimper_torch.single_view.factorization.low_rank import low_rank_problem as low_rank_problem
from pimper_torch.single_view.factorization.low_rank import random_left as random_left
from pimper_torch.single_view.factorization.low_rank import singular_left as singular_left
