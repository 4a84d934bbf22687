"""Normal equations of sparse least squares."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import csr_array
from torch import Tensor

from pimper_torch.kernels.arrays import as_array


def normal_equations(
    unknowns: Int[Tensor, "equation term"],
    coefficients: Float[Tensor, "equation term"],
    targets: Float[Tensor, " equation"],
    weights: Float[Tensor, " equation"],
    size: int,
) -> tuple[
    Int[Tensor, " entry"], Int[Tensor, " entry"], Float[Tensor, " entry"], Float[Tensor, " unknown"]
]:
    r"""Return :math:`J^T W J` and :math:`J^T W t` of equations :math:`\sum_k c_k x_{u_k} = t`.

    Args:
        coefficients: Of these unknowns. Pad shorter equations with 0 for any unknown.
        weights: Of each equation, not negative.

    Returns:
        Rows, columns and values of the matrix, duplicate entries adding up, and the
        right-hand side. Sets of equations are combined by concatenating entries and adding
        right-hand sides. Differentiable in all but the indices.
    """
    scaled = weights[:, None] * coefficients
    blocks = scaled[:, :, None] * coefficients[:, None, :]
    rows = unknowns[:, :, None].expand_as(blocks)
    cols = unknowns[:, None, :].expand_as(blocks)
    rhs = scaled.new_zeros(size).index_add(
        0, unknowns.flatten(), (scaled * targets[:, None]).flatten()
    )
    return rows.flatten(), cols.flatten(), blocks.flatten(), rhs


# Unknowns, coefficients, targets and weights of a set of equations.
Terms = tuple[Int[Tensor, "_ _"], Float[Tensor, "_ _"], Float[Tensor, " _"], Float[Tensor, " _"]]


def compressed_equations(
    kinds: Sequence[Terms], damping: Float[Tensor, " unknown"], start: Float[Tensor, " unknown"]
) -> tuple[csr_array, Float[Tensor, " unknown"]]:
    """Return the normal equations of several sets by compiled kernels, in float64 on the CPU.

    They need no memory except that of the matrix.

    Args:
        kinds: Unknowns, coefficients, targets, weights of each set; see :func:`normal_equations`.
        damping: Weight of each unknown's prior; above 0.
        start: Prior mean of each unknown.

    Returns:
        The matrix, columns sorted, and the right-hand side. Not differentiable.
    """
    from pimper_torch.kernels import normal_equations as kernels

    size = len(damping)
    prior = (torch.arange(size)[:, None], torch.ones(size, 1, dtype=start.dtype), start, damping)
    sets = []
    for unknowns, coefficients, targets, weights in (prior, *kinds):
        if len(unknowns):
            real = torch.promote_types(coefficients.dtype, targets.dtype)
            values = as_array(coefficients, real), as_array(targets, real)
            sets.append((as_array(unknowns), *values, as_array(weights, torch.float64)))
    counts, side = np.zeros(size, np.int32), np.zeros(size)
    for index, factors, target, weight in sets:
        kernels.count(index, counts)
        kernels.add_sides(index, factors, target, weight, side)
    starts = np.zeros(size, np.int32)
    np.cumsum(counts[:-1], out=starts[1:])
    total = int(counts.sum(dtype=np.int64))
    ends, columns, entries = starts.copy(), np.empty(total, np.int32), np.empty(total)
    for index, factors, _, weight in sets:
        kernels.fill(index, factors, weight, ends, columns, entries)
    first = kernels.merge(starts, ends, columns, entries)
    for array in (columns, entries):  # free the memory of duplicates, without a copy
        array.resize(first[-1], refcheck=False)
    matrix = csr_array((entries, columns, first), shape=(size, size))
    return matrix, torch.from_numpy(side)
