"""One cycle of multigrid: an approximate inverse in time proportional to the unknowns.

Coarse unknowns and matrices are found on the CPU, once; cycles run in torch on the device of the
system, or in compiled kernels on the CPU. Without these, products on the CPU go through scipy all
the same: torch's own compressed rows take up to 4 times as long there for less than a million
unknowns.

Vectors have one row an unknown, and may have one column a right-hand side.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import csr_array
from torch import Tensor

from pimper_torch.kernels.arrays import as_array
from pimper_torch.kernels.switch import compiled_for
from pimper_torch.linalg.aggregation import dominant_diagonal, prolongation
from pimper_torch.parallel import over_rows

Product = Callable[[Tensor], Tensor]

# So few unknowns are solved for by a dense inverse.
_DENSE = 400

# Coarsening that leaves more than this share of the unknowns is not worth its cycle.
_WORTHWHILE = 0.8

# Smoothing leaves alone what Chebyshev's polynomial expects of the coarse unknowns: the part
# of the spectrum, [0, 2], below 2 / _SPAN.
_SPAN = 4

# Coarse levels of other values are kept if none of them has left this factor. Measured: noise
# of a factor 1.26 (one sigma) on weights over 8 decades takes 27 cycles instead of 16; one new
# strong tie in a thousand makes all that is kept useless.
_KEPT_FACTOR = 2.0


@dataclass(frozen=True, kw_only=True)
class Level:
    """A matrix, how to smooth it and how to reach the next one."""

    product: Product
    inverse_diagonal: Float[Tensor, " unknown"]
    prolong: Product | None
    restrict: Product | None

    def corrected(
        self,
        start: Float[Tensor, "unknown ..."],
        residual: Float[Tensor, "unknown ..."],
        step: Float[Tensor, "unknown ..."],
        of_step: float,
        of_rest: float,
    ) -> Float[Tensor, "unknown ..."]:
        """Give ``start + of_step * step + of_rest * D^-1 (residual - A step)``."""
        rest = self.scaled(self.rest(residual, step))
        return torch.add(start, step, alpha=of_step).add_(rest, alpha=of_rest)

    def scaled(self, residual: Float[Tensor, "unknown ..."]) -> Float[Tensor, "unknown ..."]:
        """Give ``D^-1 residual``."""
        return self.inverse_diagonal.reshape(-1, *[1] * (residual.ndim - 1)) * residual

    def rest(
        self, residual: Float[Tensor, "unknown ..."], found: Float[Tensor, "unknown ..."]
    ) -> Float[Tensor, "unknown ..."]:
        """Give ``residual - A found``."""
        return residual - self.product(found)


@dataclass(frozen=True, kw_only=True)
class CompiledLevel(Level):
    """A level whose matrix the kernels read: once for all right-hand sides, and on all threads."""

    matrix: csr_array

    def corrected(
        self,
        start: Float[Tensor, "unknown ..."],
        residual: Float[Tensor, "unknown ..."],
        step: Float[Tensor, "unknown ..."],
        of_step: float,
        of_rest: float,
    ) -> Float[Tensor, "unknown ..."]:
        """Do the same in one pass."""
        from pimper_torch.kernels import sparse

        found = torch.empty_like(step)
        over_rows(
            sparse.corrected,
            len(step),
            *_parts(self.matrix),
            self.inverse_diagonal.numpy(),
            *(_columns(vectors) for vectors in (residual, step, start, found)),
            of_step,
            of_rest,
        )
        return found

    def rest(
        self, residual: Float[Tensor, "unknown ..."], found: Float[Tensor, "unknown ..."]
    ) -> Float[Tensor, "unknown ..."]:
        """Do the same in one pass."""
        return with_product(self.matrix, found, residual, keep=1.0, gain=-1.0)


class Hierarchy:
    """Levels of a symmetric positive definite matrix, cycled as a preconditioner.

    Args:
        matrix: In float64; both triangles.
        device: Where cycles run.
        product: Of the matrix, if there is a quicker way than its compressed rows.

    The cycle is symmetric and positive definite, as conjugate gradients need it: two
    Chebyshev-Jacobi steps before and after every coarser level.
    """

    def __init__(
        self, matrix: csr_array, device: torch.device, product: Product | None = None
    ) -> None:
        self._levels: list[Level] = []
        while True:
            spread = prolongation(matrix) if matrix.shape[0] > _DENSE else None
            if spread is not None and not 0 < spread.shape[1] < _WORTHWHILE * matrix.shape[0]:
                spread = None
            gather = None if spread is None else spread.T.tocsr()
            self._levels.append(_level(matrix, spread, gather, device, product))
            product = None
            if spread is None:
                break
            matrix = gather @ (matrix @ spread)
        small = matrix.shape[0] <= _DENSE
        self._coarsest = _dense_inverse(matrix).to(device) if small else None

    @property
    def num_levels(self) -> int:
        """The given matrix counted."""
        return len(self._levels)

    def precondition(self, residual: Float[Tensor, "unknown ..."]) -> Float[Tensor, "unknown ..."]:
        """Apply the approximate inverse."""
        return self._cycle(0, residual)

    def with_product(self, product: Product, dominant: Float[Tensor, " unknown"]) -> "Hierarchy":
        """Give a copy for a matrix not far from this one: only the finest level is new.

        Args:
            product: Of the new matrix.
            dominant: As :func:`dominant_diagonal` gives it for the new matrix.
        """
        other = object.__new__(Hierarchy)
        finest, *coarse = self._levels
        finest = Level(
            product=product,
            inverse_diagonal=1 / dominant,
            prolong=finest.prolong,
            restrict=finest.restrict,
        )
        other._levels, other._coarsest = [finest, *coarse], self._coarsest
        return other

    def _cycle(
        self, depth: int, residual: Float[Tensor, "unknown ..."]
    ) -> Float[Tensor, "unknown ..."]:
        level = self._levels[depth]
        if level.prolong is None or level.restrict is None:
            if self._coarsest is not None:
                return self._coarsest @ residual
            return _smooth(level, residual, None)
        found = _smooth(level, residual, None)
        coarse = self._cycle(depth + 1, level.restrict(level.rest(residual, found)))
        found += level.prolong(coarse)
        return _smooth(level, residual, found)


def _level(
    matrix: csr_array,
    spread: csr_array | None,
    gather: csr_array | None,
    device: torch.device,
    product: Product | None,
) -> Level:
    diagonal = torch.from_numpy(1 / dominant_diagonal(matrix)).to(device)
    parts: dict[str, Any] = {
        "product": product or sparse_product(matrix, device),
        "inverse_diagonal": diagonal,
        "prolong": None if spread is None else sparse_product(spread, device),
        "restrict": None if gather is None else sparse_product(gather, device),
    }
    if product is None and compiled_for(diagonal):
        return CompiledLevel(matrix=matrix, **parts)
    return Level(**parts)


def sparse_product(matrix: csr_array, device: torch.device) -> Product:
    """Give the product of a sparse matrix with vectors on a device, the quickest way."""
    if device.type != "cpu":
        return torch_product(matrix, device)
    if compiled_for():
        return lambda vectors: with_product(matrix, vectors)
    return lambda vectors: torch.from_numpy(matrix @ vectors.numpy())


def with_product(
    matrix: csr_array,
    vectors: Float[Tensor, "column ..."],
    start: Float[Tensor, "row ..."] | None = None,
    keep: float = 0.0,
    gain: float = 1.0,
) -> Float[Tensor, "row ..."]:
    """Give ``keep * start + gain * matrix @ vectors`` by compiled kernels."""
    from pimper_torch.kernels import sparse

    found = vectors.new_empty(matrix.shape[0], *vectors.shape[1:])
    columns = [_columns(each) for each in (vectors, found if start is None else start, found)]
    over_rows(sparse.product, len(found), *_parts(matrix), *columns, keep, gain)
    return found


def torch_product(matrix: csr_array, device: torch.device) -> Product:
    """Give the product by torch's own compressed rows."""
    with warnings.catch_warnings():  # that compressed rows are in beta state
        warnings.simplefilter("ignore", UserWarning)
        moved = torch.sparse_csr_tensor(
            torch.from_numpy(matrix.indptr),
            torch.from_numpy(matrix.indices),
            torch.from_numpy(matrix.data),
            matrix.shape,
            check_invariants=False,
        ).to(device)
    return lambda vector: moved @ vector


def may_keep(new: Float[Tensor, "..."], old: Float[Tensor, "..."]) -> bool:
    """Tell whether a hierarchy made from ``old`` entries serves for ``new`` ones."""
    ordered = torch.minimum(new.abs(), old.abs()), torch.maximum(new.abs(), old.abs())
    same_signs = bool((new.sign() == old.sign()).all())
    return same_signs and bool((ordered[1] <= _KEPT_FACTOR * ordered[0]).all())


def _smooth(
    level: Level,
    residual: Float[Tensor, "unknown ..."],
    start: Float[Tensor, "unknown ..."] | None,
) -> Float[Tensor, "unknown ..."]:
    """Take two Chebyshev steps of Jacobi's iteration towards A x = residual."""
    center, radius = 1 + 1 / _SPAN, 1 - 1 / _SPAN
    left = residual if start is None else level.rest(residual, start)
    step = level.scaled(left).div_(center)
    # Of the three-term recurrence of Chebyshev's polynomials, its second member.
    gain = 1 / (2 * center / radius - radius / center)
    of_step, of_rest = 1 + gain * radius / center, 2 * gain / radius
    if start is None:  # the step itself is where to begin
        return level.corrected(step, left, step, of_step - 1, of_rest)
    return level.corrected(start, left, step, of_step, of_rest)


def _parts(matrix: csr_array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return matrix.indptr, matrix.indices, matrix.data


def _columns(vectors: Float[Tensor, "unknown ..."]) -> np.ndarray:
    """Give vectors as the kernels want them: one column a right-hand side."""
    array = as_array(vectors)
    return array.reshape(len(array), -1)


def _dense_inverse(matrix: csr_array) -> Float[Tensor, "unknown unknown"]:
    dense = torch.from_numpy(matrix.toarray())
    scale = dense.diagonal().rsqrt()
    values, vectors = torch.linalg.eigh(scale[:, None] * dense * scale)
    # Rounding may turn what is nearly free round; the inverse must stay positive definite.
    values = values.clamp_min(torch.finfo(torch.float64).eps)
    half = scale[:, None] * vectors
    return (half / values) @ half.mT
