r"""Damped variable projection: the right factor eliminated, Gauss-Newton on the left one.

With :math:`R(L)` the best right factor, :math:`f(L) = \lVert \sqrt W (X - L R(L)) \rVert^2` has
far fewer unknowns and far fewer bad minima than the joint problem. The Gauss-Newton matrix of
f, in Ruhe and Wedin's second approximation, is

.. math:: H = \sum_k (r_k r_k^\top) \otimes (W_k - W_k L A_k^{-1} L^\top W_k),
          \quad A_k = L^\top W_k L,

for columns k. Its null space, the invertible matrices between the factors, is left to the
damping and to the QR decomposition after each step.

Source: Ruhe & Wedin, SIAM Review 22(3), 1980; Okatani, Yoshida & Deguchi, ICCV 2011; Hong &
Fitzgibbon, ICCV 2015.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.photometry.low_rank import (
    LowRank,
    checked,
    finished,
    solve_right,
    squared_error,
)
from pimper_torch.photometry.quadratics import PackedCholesky

# The damping starts at this share of the mean curvature; it falls and rises by the factors below.
# Of starts from 1e-4 to 1e-2 and factors from 3 to 10 these led most random starts to the best
# minimum known (9 of 10 on dino_trimmed; 10 and 1e-3 led 5 there).
_FIRST_DAMPING = 1e-2
_LESS, _MORE = 0.2, 5.0
_MOST_DAMPING = 1e16

# A matrix is done when so many accepted steps in a row gained less than the tolerance: one small
# step may be the end of a bend in the valley.
_SMALL_STEPS = 3

# Entries of the Gauss-Newton matrices' factors that are held at once.
_CHUNK_ENTRIES = 20_000_000


def solve_variable_projection(
    matrix: Float[Tensor, "batch row column"],
    weight: Float[Tensor, "batch row column"],
    start: Float[Tensor, "batch row rank"],
    max_iterations: int = 300,
    tolerance: float = 1e-9,
) -> LowRank:
    """Factorize a batch of matrices with missing entries by damped variable projection.

    Args:
        matrix: Entries without weight do not matter.
        weight: 0 where missing.
        start: Left factors of full rank; see :func:`~pimper_torch.photometry.low_rank.random_left`.
        max_iterations: Steps at most.
        tolerance: A matrix is done when three accepted steps in a row gained less than this
            share of its squared error.

    Returns:
        Factors in float64, the left ones with orthonormal columns. A minimum, which may be a
        bad one: start from several places.

    Raises:
        InputError: A rank, weights or entries that make no sense.

    Constant to autograd. Matrices do not influence one another.
    """
    with torch.no_grad():
        matrix, weight = checked(matrix, weight, start.shape[-1])
        left = torch.linalg.qr(start.double()).Q
        right, factored = solve_right(matrix, weight, left)
        error = squared_error(matrix, weight, left, right)
        damping = torch.full_like(error, _FIRST_DAMPING)
        small = torch.zeros_like(error)
        taken = torch.full_like(error, max_iterations).long()
        running = torch.ones_like(error, dtype=torch.bool)
        system = _equations(matrix, weight, left, right, factored)
        for step in range(max_iterations):
            moved = torch.linalg.qr(left + _move(*system, damping)).Q
            tried, tried_factors = solve_right(matrix, weight, moved)
            after = squared_error(matrix, weight, moved, tried)
            better = running & (after < error)
            gain = (error - after) / error.clamp_min(torch.finfo(error.dtype).tiny)
            small = torch.where(better, torch.where(gain < tolerance, small + 1, 0), small)
            left = torch.where(better[:, None, None], moved, left)
            error = torch.where(better, after, error)
            damping = damping * torch.where(better, _LESS, _MORE)
            ended = running & ((small >= _SMALL_STEPS) | (damping > _MOST_DAMPING) | (error == 0))
            taken[ended] = step + 1
            running = running & ~ended
            if not bool(running.any()):
                break
            if bool(better.any()):
                if not bool(better.all()):
                    tried, tried_factors = solve_right(matrix, weight, left)
                system = _equations(matrix, weight, left, tried, tried_factors)
        return finished(matrix, weight, left, taken, max_iterations)


def _equations(
    matrix: Float[Tensor, "batch row column"],
    weight: Float[Tensor, "batch row column"],
    left: Float[Tensor, "batch row rank"],
    right: Float[Tensor, "batch rank column"],
    factored: PackedCholesky,
) -> tuple[Float[Tensor, "batch unknown unknown"], Float[Tensor, "batch row rank"]]:
    """Give the Gauss-Newton matrix, unknowns row by row, and the descent direction."""
    batch, rows, rank = left.shape
    residual = weight * (matrix - left @ right)
    descent = residual @ right.mT
    # (w_fk r_k r_k^T) on the diagonal blocks, one a row of the matrix.
    products = (right[:, :, None] * right[:, None]).flatten(1, 2)
    blocks = (weight @ products.mT).reshape(batch, rows, rank, rank)
    normal = matrix.new_zeros(batch, rows, rank, rows, rank)
    index = torch.arange(rows, device=matrix.device)
    normal[:, index, :, index] = blocks.transpose(0, 1)
    normal = normal.reshape(batch, rows * rank, rows * rank)
    # C_k^-1 l_f w_fk, so that products over the rank are w_fk l_f^T A_k^-1 l_g w_gk.
    white = factored.whiten(left[..., None] * weight[:, :, None])
    size = max(1, _CHUNK_ENTRIES // (batch * rows * rank * rank))
    for first in range(0, matrix.shape[2], size):
        some = slice(first, first + size)
        spread = white[:, :, None, :, some] * right[:, None, :, None, some]
        spread = spread.reshape(batch, rows * rank, -1)
        normal = normal - spread @ spread.mT
    return normal, descent


def _move(
    normal: Float[Tensor, "batch unknown unknown"],
    descent: Float[Tensor, "batch row rank"],
    damping: Float[Tensor, " batch"],
) -> Float[Tensor, "batch row rank"]:
    """Solve for the damped step."""
    diagonal = normal.diagonal(dim1=1, dim2=2)
    ridge = damping[:, None] * diagonal.mean(dim=1, keepdim=True).clamp_min(1e-300)
    damped = normal + torch.diag_embed(ridge.expand_as(diagonal))
    return torch.linalg.solve(damped, descent.flatten(1)[..., None]).reshape(descent.shape)
