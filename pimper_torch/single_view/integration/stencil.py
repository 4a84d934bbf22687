"""The five-point stencil of a raster, and three solvers for it.

Products shift slices of the raster: up to a million pixels, compressed rows take 2 to 5 times
as long on the CPU, by ``benchmarks/linear_systems.py --products``.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import csr_array
from torch import Tensor

from pimper_torch.linalg.hierarchy import Hierarchy
from pimper_torch.linalg.multigrid import Iterate, solve_with_hierarchy
from pimper_torch.linalg.sparse import SparseCholesky
from pimper_torch.paper.poisson import solve_poisson


@dataclass(frozen=True, slots=True, kw_only=True)
class Stencil:
    """A symmetric matrix that connects pixels with their four neighbours.

    Attributes:
        right: Minus the entries between each pixel and the next in its row, float64.
        down: Minus those between each pixel and the one below.
        diagonal: Positive, of each pixel.
    """

    right: Float[Tensor, "height steps_right"]
    down: Float[Tensor, "steps_down width"]
    diagonal: Float[Tensor, "height width"]

    def product(self, vector: Float[Tensor, " pixel"]) -> Float[Tensor, " pixel"]:
        """Multiply with the heights of all pixels, row by row."""
        heights = vector.view(self.diagonal.shape)
        found = self.diagonal * heights
        found[:, 1:].addcmul_(self.right, heights[:, :-1], value=-1)
        found[:, :-1].addcmul_(self.right, heights[:, 1:], value=-1)
        found[1:].addcmul_(self.down, heights[:-1], value=-1)
        found[:-1].addcmul_(self.down, heights[1:], value=-1)
        return found.view(-1)

    def matrix(self) -> csr_array:
        """Return the compressed rows, without the entries that are zero."""
        height, width = self.diagonal.shape
        values = np.zeros((height, width, 5))
        values[1:, :, 0] = values[:-1, :, 4] = -self.down.cpu().numpy()
        values[:, 1:, 1] = values[:, :-1, 3] = -self.right.cpu().numpy()
        values[:, :, 2] = self.diagonal.cpu().numpy()
        kept = values != 0
        pixel = np.arange(height * width, dtype=np.int32).reshape(height, width, 1)
        neighbour = pixel + np.array([-width, -1, 0, 1, width], dtype=np.int32)
        starts = np.zeros(height * width + 1, dtype=np.int32)
        np.cumsum(kept.sum(axis=2).reshape(-1), out=starts[1:])
        return csr_array((values[kept], neighbour[kept], starts), shape=(height * width,) * 2)


@runtime_checkable
class RasterSolver(Protocol):
    """Solves with a stencil, for one right-hand side at a time."""

    method: str

    def iterate(
        self, rhs: Float[Tensor, "height width"], start: Float[Tensor, "height width"] | None
    ) -> Iterate:
        """Solve in float64 on the device of the stencil."""


class CholeskyRaster:
    """A sparse factor, on the CPU."""

    method = "cholesky"

    def __init__(self, stencil: Stencil, what: str) -> None:
        matrix = stencil.matrix().tocoo()
        self._factor = SparseCholesky(
            torch.from_numpy(matrix.row).long(),
            torch.from_numpy(matrix.col).long(),
            torch.from_numpy(matrix.data),
            size=matrix.shape[0],
            what=what,
        )

    def iterate(
        self, rhs: Float[Tensor, "height width"], start: Float[Tensor, "height width"] | None
    ) -> Iterate:
        """Substitute; the start is ignored."""
        found = self._factor.solve_values(rhs.reshape(-1))
        return Iterate(values=found, iterations=1)


class CosineRaster:
    """Division by frequencies, for equal weights on a full rectangle."""

    method = "cosine"

    def __init__(self, stencil: Stencil, anchor: float) -> None:
        self._anchor = anchor
        self._right, self._down = (
            float(part.flatten()[0]) if part.numel() else 1.0
            for part in (stencil.right, stencil.down)
        )

    def iterate(
        self, rhs: Float[Tensor, "height width"], start: Float[Tensor, "height width"] | None
    ) -> Iterate:
        """Transform, divide and transform back; the start is ignored."""
        found = solve_poisson(rhs, self._right, self._down, self._anchor)
        return Iterate(values=found.reshape(-1), iterations=1)


class MultigridRaster:
    """Conjugate gradients with a hierarchy, on the stencil's device.

    Args:
        tolerance: Of the error, in the energy norm, relative.
    """

    method = "multigrid"

    def __init__(self, stencil: Stencil, tolerance: float, what: str) -> None:
        self._stencil, self._tolerance, self._what = stencil, tolerance, what
        self._hierarchy = Hierarchy(stencil.matrix(), stencil.diagonal.device, stencil.product)

    def iterate(
        self, rhs: Float[Tensor, "height width"], start: Float[Tensor, "height width"] | None
    ) -> Iterate:
        """Cycle until the error is below the tolerance."""
        return solve_with_hierarchy(
            self._stencil.product,
            self._hierarchy,
            self._stencil.diagonal.reshape(-1),
            rhs.reshape(-1),
            self._tolerance,
            self._what,
            None if start is None else start.reshape(-1),
        )
