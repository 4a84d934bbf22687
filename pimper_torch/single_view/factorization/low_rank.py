r"""Low-rank factorization of matrices with missing entries, as a problem for the solvers.

Radiance is :math:`x = l^\top s` with a light ``l`` and a shading vector ``s`` that depends on
albedo and normal alone. The set of these vectors determines the ambiguity of a factorization:

=====================  ====  =============================  =====================
light                  rank  :math:`s`                      ambiguity
=====================  ====  =============================  =====================
any low-rank matrix    any   any vector                     an invertible matrix
a distant point light  3     :math:`\rho n`: any vector     an invertible 3 x 3
first order            4     :math:`\rho (1, n)`            scaled Lorentz
=====================  ====  =============================  =====================

First order is :class:`pimper_torch.method.photometry.cone.Cone`.

Source: Basri, Jacobs & Kemelmacher, IJCV 72(3), 2007; Ramamoorthi & Hanrahan, 2001.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.ground.shapes import Scalars
from pimper_torch.method.photometry.bilinear import Bilinear, Factors
from pimper_torch.method.photometry.variable_projection import solve_variable_projection
from pimper_torch.records import Record
from pimper_torch.runtime.errors import InputError

Matrices = Float[Tensor, "batch row column"]
Matrix = Float[Tensor, "row column"]
LeftFactors = Float[Tensor, "batch row rank"]
Vectors = Float[Tensor, "*batch rank"]
Columns = Float[Tensor, "*batch rank sample"]


@dataclass(frozen=True, slots=True)
class Free:
    """Any vectors: low-rank factorization, and with rank three albedo times normal."""

    rank: int = 3
    flat: ClassVar[bool] = True

    def project(self, shading: Vectors) -> Vectors:
        """Return the vector itself: it is on the manifold, and so is the end of every step."""
        return shading

    retract = project

    def curvature(
        self, shading: Columns, slope: Columns
    ) -> Float[Tensor, "*batch sample rank rank"]:
        """Return the manifold's part of second derivatives: flat, it has none."""
        return slope.new_zeros(*slope.shape[:-2], slope.shape[-1], self.rank, self.rank)

    def tangents(self, shading: Columns) -> list[Tensor]:
        """Return the axes of the space."""
        eye = torch.eye(self.rank, dtype=shading.dtype, device=shading.device)
        return [axis[:, None].expand_as(shading) for axis in eye]

    def split(self, shading: Vectors) -> tuple[Scalars, Vectors]:
        """Return lengths and directions: albedo and normals with rank three."""
        length = shading.norm(dim=-1)
        return length, shading / torch.where(length > 0, length, 1)[..., None]


def low_rank_problem(matrix: Matrices, weight: Matrices, start: LeftFactors) -> Bilinear:
    r"""Return the problem :math:`\min \sum w (X - L N)^2` over factors of low rank, in float64.

    Args:
        matrix: ``X``, rows as views, columns as samples; entries without weight are ignored.
        start: Left factors of full rank.

    Raises:
        InputError: A rank that the matrices do not have, a weight that is negative, or an
            entry with weight that is not a number.
    """
    rows, columns = matrix.shape[1:]
    rank = start.shape[2]
    if not 1 <= rank <= min(rows, columns):
        raise InputError(
            f"rank is {rank}; needed: between 1 and {min(rows, columns)} for matrices of "
            f"{rows} x {columns}."
        )
    heavy = weight.double().contiguous()
    seen = heavy > 0
    wrong = ~((heavy >= 0) & heavy.isfinite() & (matrix.isfinite() | ~seen))
    if bool(wrong.any()):
        raise InputError(
            f"{int(wrong.sum())} entries have a weight that is negative or not finite, or one "
            "above 0 but no finite value; needed: weight 0 where there is no number."
        )
    known = torch.where(seen, matrix.double(), 0).contiguous()
    left = start.double()
    return Bilinear(
        radiance=known,
        weight=heavy,
        lights=left,
        prior_mean=left,
        shading=known.new_zeros(len(known), rank, columns),
        regularization=known.new_zeros(len(known), rows),
        manifold=Free(rank=rank),
    )


def singular_left(
    matrix: Matrices,
    weight: Matrices,
    rank: int,
    guess: Matrices | None = None,
    imputations: int = 20,
) -> LeftFactors:
    """Initialize by singular vectors of the matrix, missing entries imputed iteratively.

    Missing entries start from a guess, by default the mean of their row, and are replaced by the
    low-rank approximation in turn. Orthonormal; in float64.
    """
    seen = weight > 0
    known = torch.where(seen, matrix.double(), 0)
    if guess is None:
        guess = known.sum(dim=2, keepdim=True) / seen.sum(dim=2, keepdim=True).clamp_min(1)
    filled = torch.where(seen, known, guess.double())
    for _ in range(imputations + 1):
        left = torch.linalg.eigh(filled @ filled.mT).eigenvectors[..., -rank:]
        filled = torch.where(seen, known, left @ (left.mT @ filled))
    return left


def brightness_guess(matrix: Matrix, weight: Matrix) -> Matrix:
    """Return the product of each row's and each column's brightness, for missing entries."""
    gain = (weight * matrix).sum(dim=1, keepdim=True)
    gain = gain / weight.sum(dim=1, keepdim=True).clamp_min(1e-12)
    level = (weight * gain).sum(dim=0, keepdim=True).clamp_min(1e-12)
    return gain * (weight * matrix).sum(dim=0, keepdim=True) / level


def random_left(batch: int, rows: int, rank: int, generator: torch.Generator) -> LeftFactors:
    """Draw orthonormal left factors, evenly over all subspaces."""
    drawn = torch.randn(batch, rows, rank, generator=generator, dtype=torch.float64)
    return torch.linalg.qr(drawn).Q


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Restarted(Record):
    """The best of several factorizations of one matrix.

    Attributes:
        best: A batch of one, rows as views and columns as samples.
        repeated: Whether ``repeats`` starts reached the best minimum; if not, there may well be a
            better one.
    """

    best: Factors
    residuals: Float[Tensor, " start"]
    repeated: bool


def factorize_from_many(
    matrix: Matrix,
    weight: Matrix,
    rank: int,
    generator: torch.Generator,
    *,
    repeats: int = 2,
    max_starts: int = 50,
) -> Restarted:
    """Factorize a matrix with missing entries from random starts until the best repeats.

    Args:
        repeats: Number of starts that must end in the best minimum.

    Raises:
        InputError: ``max_starts`` below ``repeats``, or an invalid matrix, weight or rank.
    """
    if not 1 <= repeats <= max_starts:
        raise InputError(
            f"repeats is {repeats} and max_starts {max_starts}; needed: 1 <= repeats <= max_starts."
        )
    best: Factors | None = None
    residuals: list[float] = []
    seen = weight > 0
    level = float((weight[seen] * matrix[seen].square()).sum() / weight[seen].sum()) ** 0.5
    for _ in range(max_starts):
        start = random_left(1, matrix.shape[0], rank, generator).to(matrix.device)
        problem = low_rank_problem(matrix[None], weight[None], start)
        found = solve_variable_projection(problem, 300, 1e-9)
        residuals.append(float(found.convergence.residual))
        if best is None or residuals[-1] < float(best.convergence.residual):
            best = found
        # On exact data the residuals are rounding, and all differ.
        same = max(min(residuals) * (1 + 1e-6), 1e-6 * level)
        repeated = sum(one <= same for one in residuals) >= repeats
        if repeated:
            break
    assert best is not None
    return Restarted(
        best=best, residuals=torch.tensor(residuals, dtype=torch.float64), repeated=repeated
    )
