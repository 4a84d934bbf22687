r"""Low-rank factorization of matrices with missing entries, as a problem for the solvers.

Radiance is :math:`x = l^\top s` with a light ``l`` and a shading vector ``s`` that only depends on
albedo and normal. The set of these vectors determines the ambiguity of a factorization:

=====================  ====  =============================  =====================
light                  rank  :math:`s`                      ambiguity
=====================  ====  =============================  =====================
any low-rank matrix    any   any vector                     an invertible matrix
a distant point light  3     :math:`\rho n`: any vector     an invertible 3 x 3
first order            4     :math:`\rho (1, n)`            scaled Lorentz
=====================  ====  =============================  =====================

First order is :class:`pimper_torch.stages.photometry.cone.Cone`.

Source: Basri, Jacobs & Kemelmacher, IJCV 72(3), 2007; Ramamoorthi & Hanrahan, 2001.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.records import Record
from pimper_torch.records.shapes import Scalars
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.torch_settings import isolated
from pimper_torch.stages.photometry.bilinear import Bilinear, Factors
from pimper_torch.stages.photometry.variable_projection import solve_variable_projection

Matrices = Float[Tensor, "batch row column"]
Matrix = Float[Tensor, "row column"]
LeftFactors = Float[Tensor, "batch row rank"]
Vectors = Float[Tensor, "*batch rank"]
Columns = Float[Tensor, "*batch rank sample"]


@dataclass(frozen=True, slots=True)
class FreeManifold:
    """Manifold of all vectors, for low-rank factorization; with rank 3, albedo times normal."""

    rank: int = 3
    flat: ClassVar[bool] = True

    def project(self, shading: Vectors) -> Vectors:
        """Return the vectors, which are on the manifold before and after every step."""
        return shading

    retract = project

    def curvature(
        self, shading: Columns, slope: Columns
    ) -> Float[Tensor, "*batch sample rank rank"]:
        """Return the manifold's part of second derivatives: zero, because it is flat."""
        return slope.new_zeros(*slope.shape[:-2], slope.shape[-1], self.rank, self.rank)

    def tangents(self, shading: Columns) -> list[Tensor]:
        """Return the axes of the space."""
        eye = torch.eye(self.rank, dtype=shading.dtype, device=shading.device)
        return [axis[:, None].expand_as(shading) for axis in eye]

    def split(self, shading: Vectors) -> tuple[Scalars, Vectors]:
        """Return lengths and directions: albedo and normals for rank 3."""
        length = shading.norm(dim=-1)
        return length, shading / torch.where(length > 0, length, 1)[..., None]


def low_rank_problem(matrix: Matrices, weight: Matrices, start: LeftFactors) -> Bilinear:
    r"""Return the problem :math:`\min \sum w (X - L N)^2` over factors of low rank, in float64.

    Args:
        matrix: ``X``, rows as views, columns as samples; entries of weight 0 are ignored.
        start: Left factors of full rank.

    Raises:
        InputError: Impossible rank, negative weight, or non-finite value of positive weight.
    """
    rows, columns = matrix.shape[1:]
    rank = start.shape[2]
    if not 1 <= rank <= min(rows, columns):
        raise InputError(
            f"rank is {rank}; needed: between 1 and {min(rows, columns)} for matrices of "
            f"{rows} x {columns}."
        )
    weights = weight.double().contiguous()
    seen = weights > 0
    invalid = ~((weights >= 0) & weights.isfinite() & (matrix.isfinite() | ~seen))
    if bool(invalid.any()):
        raise InputError(
            f"{int(invalid.sum())} entries have a weight that is negative or not finite, or a "
            "positive weight without a finite value; needed: weight 0 for missing values."
        )
    values = torch.where(seen, matrix.double(), 0).contiguous()
    left = start.double()
    return Bilinear(
        radiance=values,
        weight=weights,
        lights=left,
        prior_mean=left,
        shading=values.new_zeros(len(values), rank, columns),
        regularization=values.new_zeros(len(values), rows),
        manifold=FreeManifold(rank=rank),
    )


def singular_left(
    matrix: Matrices,
    weight: Matrices,
    rank: int,
    guess: Matrices | None = None,
    imputations: int = 20,
) -> LeftFactors:
    """Return left singular vectors of the matrix, with iteratively imputed missing entries.

    Missing entries start from a guess, by default the mean of their row, and are repeatedly
    replaced by the low-rank approximation. Orthonormal; in float64.
    """
    seen = weight > 0
    values = torch.where(seen, matrix.double(), 0)
    if guess is None:
        guess = values.sum(dim=2, keepdim=True) / seen.sum(dim=2, keepdim=True).clamp_min(1)
    filled = torch.where(seen, values, guess.double())
    for _ in range(imputations + 1):
        left = torch.linalg.eigh(filled @ filled.mT).eigenvectors[..., -rank:]
        filled = torch.where(seen, values, left @ (left.mT @ filled))
    return left


def brightness_guess(matrix: Matrix, weight: Matrix) -> Matrix:
    """Return the product of each row's and each column's brightness, for missing entries."""
    gain = (weight * matrix).sum(dim=1, keepdim=True)
    gain = gain / weight.sum(dim=1, keepdim=True).clamp_min(1e-12)
    expected = (weight * gain).sum(dim=0, keepdim=True).clamp_min(1e-12)
    return gain * (weight * matrix).sum(dim=0, keepdim=True) / expected


def random_left(batch: int, rows: int, rank: int, generator: torch.Generator) -> LeftFactors:
    """Return random orthonormal left factors, uniform over all subspaces."""
    drawn = torch.randn(batch, rows, rank, generator=generator, dtype=torch.float64)
    return torch.linalg.qr(drawn).Q


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class RestartResult(Record):
    """The best of several factorizations of one matrix.

    Attributes:
        best: Factors as a batch of one, rows as views and columns as samples.
        repeated: Whether ``repeats`` starts reached the best minimum; else a better one may exist.
    """

    best: Factors
    residuals: Float[Tensor, " start"]
    repeated: bool


@isolated
def factorize_from_many(
    matrix: Float[Tensor, "..."] | np.ndarray,
    weight: Float[Tensor, "..."] | np.ndarray,
    rank: int,
    generator: torch.Generator,
    *,
    repeats: int = 2,
    max_starts: int = 50,
) -> RestartResult:
    """Factorize a matrix with missing entries from random starts until the best repeats.

    Args:
        matrix: Rows as views, columns as samples.
        weight: Of each entry; 0 for missing ones.
        repeats: Number of starts that must end in the best minimum.

    Raises:
        InputError: ``max_starts`` below ``repeats``, or an invalid matrix, weight or rank.
    """
    if not 1 <= repeats <= max_starts:
        raise InputError(
            f"repeats is {repeats} and max_starts {max_starts}; needed: 1 <= repeats <= max_starts."
        )
    matrix, weight = torch.as_tensor(matrix), torch.as_tensor(weight)
    if matrix.ndim != 2 or weight.shape != matrix.shape:
        found = f"matrix is {tuple(matrix.shape)}, weight {tuple(weight.shape)}"
        raise InputError(f"{found}; needed: two matrices of one size, rows as views.")
    best: Factors | None = None
    residuals: list[float] = []
    seen = weight > 0
    size = float((weight[seen] * matrix[seen].square()).sum() / weight[seen].sum()) ** 0.5
    for _ in range(max_starts):
        start = random_left(1, matrix.shape[0], rank, generator).to(matrix.device)
        problem = low_rank_problem(matrix[None], weight[None], start)
        factors = solve_variable_projection(problem, 300, 1e-9)
        residuals.append(float(factors.convergence.residual))
        if best is None or residuals[-1] < float(best.convergence.residual):
            best = factors
        # On exact data, residuals are rounding errors and all differ.
        threshold = max(min(residuals) * (1 + 1e-6), 1e-6 * size)
        repeated = sum(residual <= threshold for residual in residuals) >= repeats
        if repeated:
            break
    assert best is not None
    return RestartResult(
        best=best, residuals=torch.tensor(residuals, dtype=torch.float64), repeated=repeated
    )
