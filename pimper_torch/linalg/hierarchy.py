"""The multigrid hierarchy of a matrix, and its V-cycle as a preconditioner.

Levels are built once and cycled by compiled kernels on the CPU, without gradients. Torch's
compressed rows take up to 4 times as long for less than a million unknowns.

Vectors have one row per unknown and one column per right-hand side.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import csr_array
from torch import Tensor

from pimper_torch.kernels.arrays import as_array
from pimper_torch.linalg import aggregation
from pimper_torch.records.shapes import Sides
from pimper_torch.runtime.parallel import on_one_thread, over_rows

# Maximum unknowns of a coarsest level that is solved by a dense inverse: a choice.
_DENSE = 400

# Chebyshev's polynomial smooths the spectrum, [0, 2], above 2 / _SPAN: a choice; the coarse
# unknowns reduce the rest.
_SPAN = 4

# Two steps of the three-term recurrence of Chebyshev's polynomials on that interval: the first step
# is D^-1 residual / _CENTER, the second adds _OF_STEP of it and _OF_CORRECTION of D^-1 residual.
_CENTER, _RADIUS = 1 + 1 / _SPAN, 1 - 1 / _SPAN
_GAIN = 1 / (2 * _CENTER / _RADIUS - _RADIUS / _CENTER)
_OF_STEP, _OF_CORRECTION = 1 + _GAIN * _RADIUS / _CENTER, 2 * _GAIN / _RADIUS


class Level:
    """A level: its matrix, smoother, prolongation and restriction, for all right-hand sides.

    Its vectors are allocated once: results are valid until the next cycle.

    Args:
        prolong: From the next level's unknowns to those of this level; ``None`` on the last.
        dtype: Of vectors.
    """

    def __init__(
        self,
        matrix: csr_array,
        prolong: csr_array | None,
        restrict: csr_array | None,
        dtype: torch.dtype,
    ) -> None:
        inverse = torch.from_numpy(1 / aggregation.dominant_diagonal(matrix)).to(dtype).numpy()
        self._matrix, self._inverse_diagonal = _rounded(matrix, inverse.dtype), inverse
        self._prolong = None if prolong is None else _rounded(prolong, inverse.dtype)
        self._restrict = None if restrict is None else _rounded(restrict, inverse.dtype)
        self._vectors: dict[str, Tensor] = {}

    def smoothed(self, residual: Sides, start: Sides | None = None) -> Sides:
        """Take two Chebyshev steps of Jacobi's iteration towards A x = residual."""
        from pimper_torch.kernels import sparse_products

        remaining, size = residual, len(residual)
        step, solution = (self._buffer(name, residual) for name in ("step", "solution"))
        if start is not None:
            remaining = self._buffer("remaining", residual)
            with_product(self._matrix, start, residual, keep=1.0, gain=-1.0, out=remaining)
        diagonal, rhs = self._inverse_diagonal, as_array(remaining)
        over_rows(sparse_products.jacobi_step, size, diagonal, rhs, as_array(step), 1 / _CENTER)
        vectors = [as_array(each) for each in (step, step if start is None else start, solution)]
        of_step = _OF_STEP - 1 if start is None else _OF_STEP
        arrays = *aggregation.parts_of(self._matrix), diagonal, rhs, *vectors
        over_rows(sparse_products.corrected, size, *arrays, of_step, _OF_CORRECTION)
        return solution

    def correct(self, residual: Sides, solution: Sides, coarser: Callable[[Sides], Sides]) -> None:
        """Add the next level's solution for the restricted residual, prolonged."""
        assert self._prolong is not None, "the last level has no coarser one"
        assert self._restrict is not None
        remaining = self._buffer("remaining", residual)
        with_product(self._matrix, solution, residual, keep=1.0, gain=-1.0, out=remaining)
        coarse = self._buffer("coarse", residual, self._restrict.shape[0])
        correction = coarser(with_product(self._restrict, remaining, out=coarse))
        with_product(self._prolong, correction, solution, keep=1.0, out=solution)

    def _buffer(self, name: str, like: Tensor, size: int | None = None) -> Tensor:
        """Return a named buffer, reused while its shape is the same."""
        shape = (len(like) if size is None else size, *like.shape[1:])
        if name not in self._vectors or self._vectors[name].shape != shape:
            self._vectors[name] = like.new_empty(shape)
        return self._vectors[name]


class Hierarchy:
    """Levels of a symmetric positive definite matrix; their V-cycle is a preconditioner.

    Args:
        dtype: Of cycles: float32 takes half the memory, and the same number of cycles.

    The cycle is symmetric and positive definite, as conjugate gradients require: two
    Chebyshev-Jacobi steps before and after every coarser level.
    """

    def __init__(self, matrix: csr_array, dtype: torch.dtype = torch.float64) -> None:
        self.dtype = dtype
        self._levels: list[Level] = []
        while True:
            prolong = aggregation.prolongation(matrix) if matrix.shape[0] > _DENSE else None
            if prolong is not None and not 0 < prolong.shape[1] < 0.8 * matrix.shape[0]:
                prolong = None
            restrict = None if prolong is None else prolong.T.tocsr()
            self._levels.append(Level(matrix, prolong, restrict, dtype))
            if prolong is None or restrict is None:
                break
            matrix = aggregation.coarser(matrix, prolong, restrict)
        small = matrix.shape[0] <= _DENSE
        self._coarsest = _dense_inverse(matrix).to(dtype) if small else None

    def cycle(self, residual: Sides) -> Sides:
        """Return the approximate inverse times ``residual``; the next cycle may overwrite it."""
        return self._cycle(0, residual)

    def _cycle(self, depth: int, residual: Sides) -> Sides:
        level = self._levels[depth]
        if depth + 1 == len(self._levels):
            if self._coarsest is not None:
                with on_one_thread():
                    return self._coarsest @ residual
            return level.smoothed(residual)
        solution = level.smoothed(residual)
        level.correct(residual, solution, partial(self._cycle, depth + 1))
        return level.smoothed(residual, solution)


def with_product(
    matrix: csr_array,
    vectors: Float[Tensor, "column side"],
    start: Float[Tensor, "row side"] | None = None,
    keep: float = 0.0,
    gain: float = 1.0,
    out: Float[Tensor, "row side"] | None = None,
) -> Float[Tensor, "row side"]:
    """Return ``keep * start + gain * matrix @ vectors`` by compiled kernels, in ``out``."""
    from pimper_torch.kernels import sparse_products

    if out is None:
        out = vectors.new_empty(matrix.shape[0], *vectors.shape[1:])
    columns = [as_array(each) for each in (vectors, out if start is None else start, out)]
    arrays = *aggregation.parts_of(matrix), *columns
    over_rows(sparse_products.product, len(out), *arrays, keep, gain)
    return out


def _rounded(matrix: csr_array, real: np.dtype[np.floating]) -> csr_array:
    """Return a matrix with its entries in the type ``real``; the arrays of indices are shared."""
    entries = matrix.data.astype(real, copy=False)
    return csr_array((entries, matrix.indices, matrix.indptr), shape=matrix.shape)


def _dense_inverse(matrix: csr_array) -> Float[Tensor, "unknown unknown"]:
    dense = torch.from_numpy(matrix.toarray())
    scale = dense.diagonal().rsqrt()
    with on_one_thread():
        values, vectors = torch.linalg.eigh(scale[:, None] * dense * scale)
        # Rounding may make small eigenvalues negative; the inverse must stay positive definite.
        values = values.clamp_min(torch.finfo(torch.float64).eps)
        half = scale[:, None] * vectors
        return (half / values) @ half.mT
