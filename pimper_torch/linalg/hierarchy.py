"""One cycle of multigrid: an approximate inverse in time proportional to the unknowns.

Coarse unknowns and matrices are found on the CPU, once; cycles run in torch on the device of the
system, or in compiled kernels on the CPU. Without these, products on the CPU go through scipy all
the same: torch's own compressed rows take up to 4 times as long there for less than a million
unknowns.

Vectors have one row an unknown, and may have one column a right-hand side.
"""

import warnings
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import csr_array
from torch import Tensor

from pimper_torch.kernels.arrays import as_array
from pimper_torch.kernels.switch import compiled_for
from pimper_torch.linalg.aggregation import (
    coarser,
    dominant_diagonal,
    parts_of,
    prolongation,
)
from pimper_torch.parallel import over_rows

Product = Callable[[Tensor], Tensor]

# So few unknowns are solved for by a dense inverse.
_DENSE = 400

# Coarsening that leaves more than this fraction of the unknowns is not worth its cycle.
_WORTHWHILE = 0.8

# Smoothing leaves alone what Chebyshev's polynomial expects of the coarse unknowns: the part
# of the spectrum, [0, 2], below 2 / _SPAN.
_SPAN = 4

# Two steps of the three-term recurrence of Chebyshev's polynomials on that part: the first goes
# by D^-1 residual / _CENTER, the second by _OF_STEP of that and _OF_REST of what is left.
_CENTER, _RADIUS = 1 + 1 / _SPAN, 1 - 1 / _SPAN
_GAIN = 1 / (2 * _CENTER / _RADIUS - _RADIUS / _CENTER)
_OF_STEP, _OF_REST = 1 + _GAIN * _RADIUS / _CENTER, 2 * _GAIN / _RADIUS


class Level:
    """A matrix, how to smooth it and how to reach the next one.

    Args:
        product: Of the matrix.
        inverse_diagonal: Of its dominant diagonal.
        prolong: From the next level's unknowns to those of this; nothing on the last one.
        restrict: The transpose.
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
        left = residual if start is None else residual - self.product(start)
        step = self._scaled(left).div_(_CENTER)
        rest = self._scaled(left - self.product(step))
        if start is None:  # the step itself is where to begin
            return torch.mul(step, _OF_STEP).add_(rest, alpha=_OF_REST)
        return torch.add(start, step, alpha=_OF_STEP).add_(rest, alpha=_OF_REST)

    def coarse_residual(
        self, residual: Float[Tensor, "unknown ..."], found: Float[Tensor, "unknown ..."]
    ) -> Float[Tensor, "coarse ..."]:
        """Give what is left of a residual, to the next level."""
        assert self.restrict is not None
        return self.restrict(residual - self.product(found))

    def add_coarse(
        self, found: Float[Tensor, "unknown ..."], coarse: Float[Tensor, "coarse ..."]
    ) -> None:
        """Add the next level's answer."""
        assert self.prolong is not None
        found += self.prolong(coarse)

    def _scaled(self, residual: Float[Tensor, "unknown ..."]) -> Float[Tensor, "unknown ..."]:
        return self.inverse_diagonal.reshape(-1, *[1] * (residual.ndim - 1)) * residual


class CompiledLevel(Level):
    """A level whose matrices the kernels read: once for all right-hand sides, on all threads.

    Its vectors are made once, so that what it gives lasts until the next cycle.

    Args:
        matrix: Of this level.
        inverse_diagonal: Of its dominant diagonal, in the type of everything here.
        spread: From the next level's unknowns to those of this; nothing on the last one.
        gather: The transpose.
    """

    def __init__(
        self,
        matrix: csr_array,
        inverse_diagonal: Float[Tensor, " unknown"],
        spread: csr_array | None,
        gather: csr_array | None,
    ) -> None:
        def product(matrix: csr_array | None) -> Product | None:
            return None if matrix is None else lambda vectors: with_product(matrix, vectors)

        real = inverse_diagonal.numpy().dtype
        self._matrix = matrix.astype(real, copy=False)
        self._spread = None if spread is None else spread.astype(real, copy=False)
        self._gather = None if gather is None else gather.astype(real, copy=False)
        own = product(self._matrix)
        assert own is not None
        super().__init__(own, inverse_diagonal, product(self._spread), product(self._gather))
        self._vectors: dict[str, Tensor] = {}

    def smoothed(
        self,
        residual: Float[Tensor, "unknown ..."],
        start: Float[Tensor, "unknown ..."] | None = None,
    ) -> Float[Tensor, "unknown ..."]:
        """Do the same in three passes."""
        from pimper_torch.kernels import sparse

        left, size = residual, len(residual)
        step, found = (self._room(name, residual) for name in ("step", "found"))
        if start is not None:
            left = self._room("left", residual)
            with_product(self._matrix, start, residual, keep=1.0, gain=-1.0, found=left)
        diagonal = self.inverse_diagonal.numpy()
        over_rows(sparse.scaled, size, diagonal, _columns(left), _columns(step), 1 / _CENTER)
        vectors = [_columns(each) for each in (left, step, step if start is None else start, found)]
        of_step = _OF_STEP - 1 if start is None else _OF_STEP
        parts = parts_of(self._matrix)
        over_rows(sparse.corrected, size, *parts, diagonal, *vectors, of_step, _OF_REST)
        return found

    def coarse_residual(
        self, residual: Float[Tensor, "unknown ..."], found: Float[Tensor, "unknown ..."]
    ) -> Float[Tensor, "coarse ..."]:
        """Do the same without new vectors."""
        assert self._gather is not None
        left = self._room("left", residual)
        with_product(self._matrix, found, residual, keep=1.0, gain=-1.0, found=left)
        coarse = self._room("coarse", residual, self._gather.shape[0])
        return with_product(self._gather, left, found=coarse)

    def add_coarse(
        self, found: Float[Tensor, "unknown ..."], coarse: Float[Tensor, "coarse ..."]
    ) -> None:
        """Do the same in one pass."""
        assert self._spread is not None
        with_product(self._spread, coarse, found, keep=1.0, found=found)

    def _room(self, name: str, like: Tensor, size: int | None = None) -> Tensor:
        """Give the vectors of a name: those of the last cycle, if they had as many columns."""
        shape = (len(like) if size is None else size, *like.shape[1:])
        if name not in self._vectors or self._vectors[name].shape != shape:
            self._vectors[name] = like.new_empty(shape)
        return self._vectors[name]


class Hierarchy:
    """Levels of a symmetric positive definite matrix, cycled as a preconditioner.

    Args:
        matrix: In float64; both triangles.
        device: Where cycles run.
        product: Of the matrix, if there is a quicker way than its compressed rows.
        dtype: That compiled cycles compute in: float32 takes half the memory, and as many cycles.

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
            spread = prolongation(matrix) if matrix.shape[0] > _DENSE else None
            if spread is not None and not 0 < spread.shape[1] < _WORTHWHILE * matrix.shape[0]:
                spread = None
            gather = None if spread is None else spread.T.tocsr()
            self._levels.append(_level(matrix, spread, gather, device, product, dtype))
            product = None
            if spread is None or gather is None:
                break
            matrix = coarser(matrix, spread, gather)
        small = matrix.shape[0] <= _DENSE
        self._coarsest = _dense_inverse(matrix).to(device) if small else None

    @property
    def num_levels(self) -> int:
        """The given matrix counted."""
        return len(self._levels)

    def precondition(self, residual: Float[Tensor, "unknown ..."]) -> Float[Tensor, "unknown ..."]:
        """Apply the approximate inverse."""
        return self.cycle(residual).clone()

    def cycle(self, residual: Float[Tensor, "unknown ..."]) -> Float[Tensor, "unknown ..."]:
        """Do the same, in vectors that the next cycle may write to."""
        return self._cycle(0, residual)

    def with_product(self, product: Product, dominant: Float[Tensor, " unknown"]) -> "Hierarchy":
        """Give a copy for a matrix not far from this one: only the finest level is new.

        Args:
            product: Of the new matrix.
            dominant: As :func:`dominant_diagonal` gives it for the new matrix.
        """
        other = object.__new__(Hierarchy)
        finest, *coarse = self._levels
        finest = Level(product, 1 / dominant, finest.prolong, finest.restrict)
        other._levels, other._coarsest = [finest, *coarse], self._coarsest
        return other

    def _cycle(
        self, depth: int, residual: Float[Tensor, "unknown ..."]
    ) -> Float[Tensor, "unknown ..."]:
        level = self._levels[depth]
        if depth + 1 == len(self._levels):
            if self._coarsest is not None:
                return self._coarsest.to(residual) @ residual
            return level.smoothed(residual)
        found = level.smoothed(residual)
        coarse = self._cycle(depth + 1, level.coarse_residual(residual, found))
        level.add_coarse(found, coarse)
        return level.smoothed(residual, found)


def _level(
    matrix: csr_array,
    spread: csr_array | None,
    gather: csr_array | None,
    device: torch.device,
    product: Product | None,
    dtype: torch.dtype,
) -> Level:
    diagonal = torch.from_numpy(1 / dominant_diagonal(matrix)).to(device)
    if product is None and compiled_for(diagonal):
        return CompiledLevel(matrix, diagonal.to(dtype), spread, gather)
    return Level(
        product=product or sparse_product(matrix, device),
        inverse_diagonal=diagonal,
        prolong=None if spread is None else sparse_product(spread, device),
        restrict=None if gather is None else sparse_product(gather, device),
    )


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
    found: Float[Tensor, "row ..."] | None = None,
) -> Float[Tensor, "row ..."]:
    """Give ``keep * start + gain * matrix @ vectors`` by compiled kernels, in ``found`` or new."""
    from pimper_torch.kernels import sparse

    if found is None:
        found = vectors.new_empty(matrix.shape[0], *vectors.shape[1:])
    columns = [_columns(each) for each in (vectors, found if start is None else start, found)]
    over_rows(sparse.product, len(found), *parts_of(matrix), *columns, keep, gain)
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
