"""Refusal of singular systems."""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.errors import NumericalError

# Maximum residual of a solution, with the diagonal scaled to 1, relative to the right-hand side: a
# choice, far above rounding and far below any noise of the data.
WORST_RESIDUAL = 1e-6


class SingularSystemError(NumericalError):
    """Linear equations that do not determine their unknowns."""


def refuse_hopeless(
    entries: Float[Tensor, " entry"], diagonal: Float[Tensor, " unknown"], what: str
) -> None:
    """Refuse entries that are not finite and unknowns without a positive diagonal."""
    if not bool(entries.isfinite().all()):
        raise SingularSystemError(
            f"{what} has {int((~entries.isfinite()).sum())} entries that are not finite "
            "numbers; all must be. Look for zero weights or invalid samples in its input."
        )
    empty = torch.nonzero(diagonal <= 0).flatten()
    if len(empty):
        raise SingularSystemError(
            f"{what} leaves {len(empty)} of {len(diagonal)} unknowns without a positive "
            f"diagonal (the first is unknown {int(empty[0])}); each needs at least one equation "
            "with positive weight. Add data or a prior for them."
        )
