"""The multigrid hierarchy of a matrix, and its V-cycle as a preconditioner.

Levels are built on the CPU, once, by compiled kernels: they are constant to autograd. Cycles run in
compiled kernels, too, or in torch on another device. On the CPU torch's compressed rows take up to
4 times as long for less than a million unknowns.

Vectors have one row per unknown, and may have one column per right-hand side.
"""

import warnings
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import csr_array
from torch import Tensor

from pimper_torch.ground.kernels.arrays import as_array
from pimper_torch.ground.linalg.aggregation import (
    coarser,
    dominant_diagonal,
    parts_of,
    prolongation,
)
from pimper_torch.runtime.parallel import on_one_thread, over_rows

Product = Callable[[Tensor], Tensor]

# Up to so many unknowns, the coarsest level is solved by a dense inverse: a choice.
_DENSE = 400

# Chebyshev's polynomial smooths the part of the spectrum, [0, 2], above 2 / _SPAN: a choice; the
# part below is left to the coarse unknowns.
_SPAN = 4

# Two steps of the three-term recurrence of Chebyshev's polynomials on that part: the first goes
# by D^-1 residual / _CENTER, the second by _OF_STEP of that and _OF_CORRECTION of D^-1 residual.
_CENTER, _RADIUS = 1 + 1 / _SPAN, 1 - 1 / _SPAN
_GAIN = 1 / (2 * _CENTER / _RADIUS - _RADIUS / _CENTER)
_OF_STEP, _OF_CORRECTION = 1 + _GAIN * _RADIUS / _CENTER, 2 * _GAIN / _RADIUS


class Level:
    """A level: its matrix, smoother, prolongation and restriction.

    Args:
        prolong: From the next level's unknowns to this one's; ``None`` on the last.
    """

    def __init__(
        self,
        product: Product,
        inverse_diagonal: Float[Tensor, " unknown"],
        prolong: Product | None,
        restrict: Product | None,
    ) -> None:
        self.product, self.inverse_diagonal = product, inverse_diagonal
        self.prolong, self.restrict = prolong, restrict

    def smoothed(
        self,
        residual: Float[Tensor, "unknown ..."],
        start: Float[Tensor, "unknown ..."] | None = None,
    ) -> Float[Tensor, "unknown ..."]:
        """Take two Chebyshev steps of Jacobi's iteration towards A x = residual."""
        remaining = residual if start is None else residual - self.product(start)
        step = self._scaled(remaining).div_(_CENTER)
        correction = self._scaled(remaining - self.product(step))
        if start is None:  # the start is zero
            return torch.mul(step, _OF_STEP).add_(correction, alpha=_OF_CORRECTION)
        return torch.add(start, step, alpha=_OF_STEP).add_(correction, alpha=_OF_CORRECTION)

    def coarse_residual(
        self, residual: Float[Tensor, "unknown ..."], found: Float[Tensor, "unknown ..."]
    ) -> Float[Tensor, "coarse ..."]:
        """Return the restricted residual of a solution."""
        assert self.restrict is not None
        return self.restrict(residual - self.product(found))

    def add_coarse(
        self, found: Float[Tensor, "unknown ..."], coarse: Float[Tensor, "coarse ..."]
    ) -> None:
        """Add the prolonged correction of the next level."""
        assert self.prolong is not None
        found += self.prolong(coarse)

    def _scaled(self, residual: Float[Tensor, "unknown ..."]) -> Float[Tensor, "unknown ..."]:
        return self.inverse_diagonal.reshape(-1, *[1] * (residual.ndim - 1)) * residual


class CompiledLevel(Level):
    """A level by compiled kernels: all right-hand sides at once, on all threads.

    Its vectors are allocated once: results are valid until the next cycle.

    Args:
        inverse_diagonal: Of its dominant diagonal, in the dtype of the level.
        prolong_matrix: From the next level's unknowns to this one's; ``None`` on the last.
    """

    def __init__(
        self,
        matrix: csr_array,
        inverse_diagonal: Float[Tensor, " unknown"],
        prolong_matrix: csr_array | None,
        restrict_matrix: csr_array | None,
    ) -> None:
        def product(matrix: csr_array | None) -> Product | None:
            return None if matrix is None else lambda vectors: with_product(matrix, vectors)

        real = inverse_diagonal.numpy().dtype
        self._matrix = _rounded(matrix, real)
        self._prolong_matrix = None if prolong_matrix is None else _rounded(prolong_matrix, real)
        self._restrict_matrix = None if restrict_matrix is None else _rounded(restrict_matrix, real)
        own = product(self._matrix)
        assert own is not None
        super().__init__(
            own, inverse_diagonal, product(self._prolong_matrix), product(self._restrict_matrix)
        )
        self._vectors: dict[str, Tensor] = {}

    def smoothed(
        self,
        residual: Float[Tensor, "unknown ..."],
        start: Float[Tensor, "unknown ..."] | None = None,
    ) -> Float[Tensor, "unknown ..."]:
        """Smooth in three passes; see :meth:`Level.smoothed`."""
        from pimper_torch.ground.kernels import sparse_products

        remaining, size = residual, len(residual)
        step, found = (self._buffer(name, residual) for name in ("step", "found"))
        if start is not None:
            remaining = self._buffer("left", residual)
            with_product(self._matrix, start, residual, keep=1.0, gain=-1.0, found=remaining)
        diagonal = self.inverse_diagonal.numpy()
        over_rows(
            sparse_products.scaled, size, diagonal, _columns(remaining), _columns(step), 1 / _CENTER
        )
        vectors = [
            _columns(each) for each in (remaining, step, step if start is None else start, found)
        ]
        of_step = _OF_STEP - 1 if start is None else _OF_STEP
        parts = parts_of(self._matrix)
        over_rows(
            sparse_products.corrected, size, *parts, diagonal, *vectors, of_step, _OF_CORRECTION
        )
        return found

    def coarse_residual(
        self, residual: Float[Tensor, "unknown ..."], found: Float[Tensor, "unknown ..."]
    ) -> Float[Tensor, "coarse ..."]:
        """Return the restricted residual without new vectors."""
        assert self._restrict_matrix is not None
        remaining = self._buffer("left", residual)
        with_product(self._matrix, found, residual, keep=1.0, gain=-1.0, found=remaining)
        coarse = self._buffer("coarse", residual, self._restrict_matrix.shape[0])
        return with_product(self._restrict_matrix, remaining, found=coarse)

    def add_coarse(
        self, found: Float[Tensor, "unknown ..."], coarse: Float[Tensor, "coarse ..."]
    ) -> None:
        """Add the prolonged correction in one pass."""
        assert self._prolong_matrix is not None
        with_product(self._prolong_matrix, coarse, found, keep=1.0, found=found)

    def _buffer(self, name: str, like: Tensor, size: int | None = None) -> Tensor:
        """Return a named buffer, kept from cycle to cycle while its shape is the same."""
        shape = (len(like) if size is None else size, *like.shape[1:])
        if name not in self._vectors or self._vectors[name].shape != shape:
            self._vectors[name] = like.new_empty(shape)
        return self._vectors[name]


class Hierarchy:
    """Levels of a symmetric positive definite matrix, cycled as a preconditioner.

    Args:
        product: Of the matrix, if there is a faster one than by compressed rows.
        dtype: Of compiled cycles: float32 takes half the memory, and as many cycles.

    The cycle is symmetric and positive definite, as conjugate gradients need it: two
    Chebyshev-Jacobi steps before and after every coarser level.
    """

    def __init__(
        self,
        matrix: csr_array,
        device: torch.device,
        product: Product | None = None,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        self._levels: list[Level] = []
        while True:
            prolong_matrix = prolongation(matrix) if matrix.shape[0] > _DENSE else None
            if (
                prolong_matrix is not None
                and not 0 < prolong_matrix.shape[1] < 0.8 * matrix.shape[0]
            ):
                prolong_matrix = None
            restrict_matrix = None if prolong_matrix is None else prolong_matrix.T.tocsr()
            self._levels.append(
                _level(matrix, prolong_matrix, restrict_matrix, device, product, dtype)
            )
            product = None
            if prolong_matrix is None or restrict_matrix is None:
                break
            matrix = coarser(matrix, prolong_matrix, restrict_matrix)
        small = matrix.shape[0] <= _DENSE
        self._coarsest = _dense_inverse(matrix).to(device) if small else None

    def precondition(self, residual: Float[Tensor, "unknown ..."]) -> Float[Tensor, "unknown ..."]:
        """Apply the approximate inverse."""
        return self.cycle(residual).clone()

    def cycle(self, residual: Float[Tensor, "unknown ..."]) -> Float[Tensor, "unknown ..."]:
        """Apply the approximate inverse; the next cycle may overwrite the result."""
        return self._cycle(0, residual)

    def _cycle(
        self, depth: int, residual: Float[Tensor, "unknown ..."]
    ) -> Float[Tensor, "unknown ..."]:
        level = self._levels[depth]
        if depth + 1 == len(self._levels):
            if self._coarsest is not None:
                with on_one_thread():
                    return self._coarsest.to(residual) @ residual
            return level.smoothed(residual)
        found = level.smoothed(residual)
        coarse = self._cycle(depth + 1, level.coarse_residual(residual, found))
        level.add_coarse(found, coarse)
        return level.smoothed(residual, found)


def _level(
    matrix: csr_array,
    prolong_matrix: csr_array | None,
    restrict_matrix: csr_array | None,
    device: torch.device,
    product: Product | None,
    dtype: torch.dtype,
) -> Level:
    diagonal = torch.from_numpy(1 / dominant_diagonal(matrix)).to(device)
    if product is None and device.type == "cpu":
        return CompiledLevel(matrix, diagonal.to(dtype), prolong_matrix, restrict_matrix)
    return Level(
        product=product or sparse_product(matrix, device),
        inverse_diagonal=diagonal,
        prolong=None if prolong_matrix is None else sparse_product(prolong_matrix, device),
        restrict=None if restrict_matrix is None else sparse_product(restrict_matrix, device),
    )


def sparse_product(matrix: csr_array, device: torch.device) -> Product:
    """Return the fastest product of a sparse matrix with vectors on a device."""
    if device.type != "cpu":
        return torch_product(matrix, device)
    return lambda vectors: with_product(matrix, vectors)


def with_product(
    matrix: csr_array,
    vectors: Float[Tensor, "column ..."],
    start: Float[Tensor, "row ..."] | None = None,
    keep: float = 0.0,
    gain: float = 1.0,
    found: Float[Tensor, "row ..."] | None = None,
) -> Float[Tensor, "row ..."]:
    """Return ``keep * start + gain * matrix @ vectors`` by compiled kernels, into ``found``."""
    from pimper_torch.ground.kernels import sparse_products

    if found is None:
        found = vectors.new_empty(matrix.shape[0], *vectors.shape[1:])
    columns = [_columns(each) for each in (vectors, found if start is None else start, found)]
    over_rows(sparse_products.product, len(found), *parts_of(matrix), *columns, keep, gain)
    return found


def torch_product(matrix: csr_array, device: torch.device) -> Product:
    """Return the product by torch's compressed rows."""
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


def _rounded(matrix: csr_array, real: np.dtype[np.floating]) -> csr_array:
    """Return a matrix with entries of another type; the arrays of indices are shared."""
    entries = matrix.data.astype(real, copy=False)
    return csr_array((entries, matrix.indices, matrix.indptr), shape=matrix.shape)


def _columns(vectors: Float[Tensor, "unknown ..."]) -> np.ndarray:
    """Return vectors as arrays with one column per right-hand side."""
    array = as_array(vectors)
    return array.reshape(len(array), -1)


def _dense_inverse(matrix: csr_array) -> Float[Tensor, "unknown unknown"]:
    dense = torch.from_numpy(matrix.toarray())
    scale = dense.diagonal().rsqrt()
    with on_one_thread():
        values, vectors = torch.linalg.eigh(scale[:, None] * dense * scale)
        # Rounding may make small eigenvalues negative; the inverse must stay positive definite.
        values = values.clamp_min(torch.finfo(torch.float64).eps)
        half = scale[:, None] * vectors
        return (half / values) @ half.mT
