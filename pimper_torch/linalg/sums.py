"""Sums that do not depend on the number of threads.

Torch splits long sums between threads: their number changes the order of additions and last bits.
"""

from jaxtyping import Float, Int, Shaped
from torch import Tensor
from torch.nn.functional import pad

from pimper_torch.records.shapes import Scalar, Scalars

# Values in a block: each block is a row, which one thread sums, as it does up to this many rows.
_BLOCK = 4096


def total(values: Float[Tensor, "*shape"]) -> Scalar:
    """Sum all values, block by block. Differentiable.

    >>> import torch
    >>> total(torch.arange(5.0))
    tensor(10.)
    """
    flat = values.reshape(-1)
    while len(flat) > _BLOCK:
        flat = pad(flat, (0, -len(flat) % _BLOCK)).reshape(-1, _BLOCK).sum(dim=1)
    return flat.sum()


def along_last(values: Float[Tensor, "*batch item"]) -> Scalars:
    """Sum along the last dimension; a single row as by :func:`total`."""
    return total(values) if values.dim() == 1 else values.sum(dim=-1)


def average(values: Float[Tensor, "*shape"]) -> Scalar:
    """Return the mean of all values, summed as by :func:`total`; NaN without values."""
    return total(values) / values.numel()


def sum_at(
    index: Int[Tensor, " entry"], values: Shaped[Tensor, "entry ..."], count: int
) -> Shaped[Tensor, "group ..."]:
    """Return the sum of the values in each group; 0 for an empty group. Differentiable.

    Args:
        index: The group of each value, below ``count``.

    >>> import torch
    >>> sum_at(torch.tensor([2, 0, 2]), torch.tensor([1.0, 2.0, 3.0]), 3)
    tensor([2., 0., 4.])
    """
    return values.new_zeros(count, *values.shape[1:]).index_add(0, index, values)
