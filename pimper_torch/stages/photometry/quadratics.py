"""Batched small symmetric systems in packed form: weighted least squares per sample.

A symmetric n x n matrix is stored as its upper triangle, row by row, in the second to last axis:
10 entries for n = 4. One matrix product assembles millions of them, and elementwise arithmetic
solves them, without a library call for each.
"""

from collections.abc import Sequence
from itertools import combinations_with_replacement

import torch
from jaxtyping import Float
from torch import Tensor

Columns = Float[Tensor, "*batch size item"]
Packed = Float[Tensor, "*batch packed item"]
Components = Float[Tensor, "*batch smaller item"]


def outer(vectors: Columns) -> Packed:
    """Return the upper triangle of ``v v^T`` for each column ``v``.

    >>> outer(torch.tensor([[1.0], [2.0]]))[:, 0]
    tensor([1., 2., 4.])
    """
    rows, columns = _triangle(vectors.shape[-2])
    return vectors[..., rows, :] * vectors[..., columns, :]


def diagonal(size: int) -> list[int]:
    """Return the indices of the diagonal in the packed form."""
    rows, columns = _triangle(size)
    return [slot for slot, pair in enumerate(zip(rows, columns, strict=True)) if len({*pair}) < 2]


def unpacked(packed: Packed, size: int) -> Float[Tensor, "*batch item size size"]:
    """Return the full matrices."""
    rows, columns = _triangle(size)
    index = torch.zeros(size, size, dtype=torch.long, device=packed.device)
    slot = torch.arange(len(rows), device=packed.device)
    index[rows, columns] = slot
    index[columns, rows] = slot
    return packed.mT[..., index]


def apply_packed(packed: Packed, vectors: Columns) -> Columns:
    """Return the product of each packed matrix with its vector."""
    entries, components = packed.unbind(dim=-2), vectors.unbind(dim=-2)
    rows, columns = _triangle(len(components))
    total = [torch.zeros_like(components[0] * entries[0])] * len(components)
    for entry, row, column in zip(entries, rows, columns, strict=True):
        total[row] = torch.addcmul(total[row], entry, components[column])
        if row != column:
            total[column] = torch.addcmul(total[column], entry, components[row])
    return torch.stack(total, dim=-2)


def dot(first: Columns, second: Columns) -> Float[Tensor, "*batch item"]:
    """Return inner products, several times faster than a sum over the axis."""
    total = torch.zeros_like(second[..., 0, :])
    for a, b in zip(first.unbind(dim=-2), second.unbind(dim=-2), strict=True):
        total = torch.addcmul(total, a, b)
    return total


def coordinates(columns: Sequence[Tensor], vectors: Columns) -> Components:
    """Return ``B^T v`` for matrices ``B`` given by their columns."""
    return torch.stack([dot(column, vectors) for column in columns], dim=-2)


def combination(columns: Sequence[Tensor], weights: Components) -> Columns:
    """Return ``B c`` for matrices ``B`` given by their columns."""
    total = torch.zeros_like(columns[0])
    for column, weight in zip(columns, weights.unbind(dim=-2), strict=True):
        total = total + column * weight[..., None, :]
    return total


def congruence(packed: Packed, columns: list[Columns]) -> Components:
    """Return ``B^T A B``, packed, for matrices ``B`` given by their columns."""
    images = [apply_packed(packed, column) for column in columns]
    rows, others = _triangle(len(columns))
    return torch.stack(
        [(columns[row] * images[slot]).sum(dim=-2) for row, slot in zip(rows, others, strict=True)],
        dim=-2,
    )


def solve_packed(packed: Packed, rhs: Columns) -> Columns:
    """Return solutions of symmetric positive systems; see :class:`PackedCholesky`."""
    return PackedCholesky(packed, rhs.shape[-2]).solve(rhs)


class PackedCholesky:
    """Factors ``A = C C^T`` of many small symmetric positive matrices, in float64.

    Pivots are at least the rounding error of the matrix's trace, 1e-12 of it in float64, so
    solutions of singular systems are finite. A zero matrix, or one whose trace underflows, is
    treated as the identity. Differentiable.
    """

    def __init__(self, packed: Packed, size: int) -> None:
        rows, columns = _triangle(size)
        entries = {
            (column, row): entry.double()
            for entry, row, column in zip(packed.unbind(dim=-2), rows, columns, strict=True)
        }
        trace = torch.stack([entries[i, i] for i in range(size)]).sum(dim=0).detach()
        kind = torch.finfo(packed.dtype)
        floor = torch.where(trace > kind.tiny / kind.eps, max(1e-12, kind.eps) * trace, 1)
        self._size, self._lower = size, dict[tuple[int, int], Tensor]()
        lower = self._lower
        for i in range(size):
            for j in range(i + 1):
                total = entries[i, j]
                for k in range(j):
                    total = torch.addcmul(total, lower[i, k], lower[j, k], value=-1)
                lower[i, j] = torch.maximum(total, floor).sqrt() if i == j else total / lower[j, j]

    def solve(self, rhs: Columns) -> Columns:
        """Return ``A^-1 b``, in the dtype of ``b``."""
        solution = self.whiten(rhs.unbind(dim=-2))
        for i in reversed(range(self._size)):
            value = solution[i]
            for k in range(i + 1, self._size):
                value = torch.addcmul(value, self._lower[k, i], solution[k], value=-1)
            solution[i] = value / self._lower[i, i]
        return torch.stack(solution, dim=-2).to(rhs.dtype)

    def whiten(self, rows: Sequence[Float[Tensor, "*batch item"]]) -> list[Tensor]:
        """Return the rows of ``C^-1 b``, float64; their inner products are ``b^T A^-1 b'``."""
        forward: list[Tensor] = []
        for i, row in enumerate(rows):
            value = row.double()
            for k in range(i):
                value = torch.addcmul(value, self._lower[i, k], forward[k], value=-1)
            forward.append(value / self._lower[i, i])
        return forward


def _triangle(size: int) -> tuple[list[int], list[int]]:
    pairs = list(combinations_with_replacement(range(size), 2))
    return [row for row, _ in pairs], [column for _, column in pairs]
