r"""Weighted least squares on the differences of neighbouring pixels: a graph Laplacian.

.. math:: \min_z \sum_e w_e (z_{e+} - z_{e-} - g_e)^2 + \sum_i a_i (z_i - c_i)^2

over the edges ``e`` between a pixel and the next to the right or below. The matrix,
:math:`D^T W D + \mathrm{diag}(a)`, is a graph Laplacian with anchors. A mask is weights that
are zero: a pixel without edges and without anchor is outside, and gets 0.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.sparse import csr_array
from torch import Tensor
from torch.nn.functional import pad

from pimper_torch.geometry.topology import graph_components
from pimper_torch.linalg.hierarchy import Hierarchy, sparse_product
from pimper_torch.linalg.multigrid import solve_with_hierarchy
from pimper_torch.linalg.prepared import DEFAULT_TOLERANCE
from pimper_torch.linalg.sparse import SparseCholesky
from pimper_torch.paper.integrate import differences, differences_transposed

# Here a factor takes twice as long to make as a hierarchy (0.17 s against 0.08 s) and a third
# as long to use; below it is as quick in all, and its solutions are exact.
_CHOLESKY_PIXELS = 20_000


class RasterSystem:
    r"""The matrix :math:`D^T W D + \mathrm{diag}(a)` of a raster, for any number of solves.

    Args:
        weight_right: Of the step from each pixel to the next in its row; finite, not negative.
        anchor: ``a``, of each pixel's known height; not negative. None for no anchors.
        tolerance: Of the error, in the energy norm, relative.

    A connected component without anchor has mean 0; the mean of its right-hand side is ignored.
    Weights may vary over ten orders, with holes, islands and single pixels. Heights are computed
    in float64, and returned in the device and dtype of the right-hand side.

    >>> system = RasterSystem(torch.ones(2, 1), torch.ones(1, 2))
    >>> system.fit_steps(torch.ones(2, 1), torch.zeros(1, 2))
    tensor([[-0.5000,  0.5000],
            [-0.5000,  0.5000]])
    """

    def __init__(
        self,
        weight_right: Float[Tensor, "height steps_right"],
        weight_down: Float[Tensor, "steps_down width"],
        anchor: Float[Tensor, "height width"] | None = None,
        *,
        tolerance: float = DEFAULT_TOLERANCE,
        what: str = "the raster",
    ) -> None:
        self._tolerance, self._what = tolerance, what
        if anchor is None:
            anchor = weight_right.new_zeros(weight_right.shape[0], weight_down.shape[1])
        self._given = (weight_right, weight_down, anchor)
        with torch.no_grad():
            right, down, anchors = (part.detach().cpu().double() for part in self._given)
            across = pad(right, (1, 0)) + pad(right, (0, 1))
            row_sum = across + pad(down, (0, 0, 1, 0)) + pad(down, (0, 0, 0, 1)) + anchors
            self._inside = (row_sum > 0).flatten()
            self._free(right > 0, down > 0, anchors > 0)
            diagonal = torch.where(self._inside, row_sum.flatten(), 1)
            # Doubled at one pixel of each free component, so that the matrix is definite. With a
            # right-hand side of mean zero this fixes that pixel at 0 and changes nothing else.
            diagonal = diagonal.index_add(0, self._root, diagonal[self._root])
            matrix = _compressed(right, down, diagonal.view(row_sum.shape))
            self._factor = None
            if len(diagonal) <= _CHOLESKY_PIXELS:
                index = matrix.tocoo()
                self._factor = SparseCholesky(
                    torch.from_numpy(index.row).long(),
                    torch.from_numpy(index.col).long(),
                    torch.from_numpy(index.data),
                    len(diagonal),
                    what,
                )
                return
            cpu = diagonal.device
            self._cycles = sparse_product(matrix, cpu), Hierarchy(matrix, cpu), diagonal

    def solve(
        self, source: Float[Tensor, "*batch height width"]
    ) -> Float[Tensor, "*batch height width"]:
        r"""Solve :math:`(D^T W D + \mathrm{diag}(a)) z = s`.

        Args:
            source: ``s``; ignored outside, and its mean over each free component.

        Differentiable in ``source`` and in all weights, any number of times, by one more solve.
        Anchors of free components get no gradient.

        Raises:
            SingularSystemError: A source or weights that are not finite.
        """
        found: Tensor = _RasterSolve.apply(self, *self._given, source)  # type: ignore[no-untyped-call]
        return found

    def fit_steps(
        self,
        right: Float[Tensor, "height steps_right"],
        down: Float[Tensor, "steps_down width"],
        heights: Float[Tensor, "height width"] | None = None,
    ) -> Float[Tensor, "height width"]:
        """Return the heights whose steps and anchored pixels are nearest to those given.

        Args:
            right: Target steps to the right; ignored, NaN included, without weight.
            heights: Known heights, likewise where there is no anchor; None for zero.
        """
        weight_right, weight_down, anchor = self._given
        source = differences_transposed(_times(weight_right, right), _times(weight_down, down))
        if heights is not None:
            source = source + _times(anchor, heights)
        return self.solve(source).to(right)

    def solve_values(
        self,
        source: Float[Tensor, "*batch height width"],
        start: Float[Tensor, "height width"] | None = None,
    ) -> Float[Tensor, "*batch height width"]:
        """Solve, constant to autograd.

        Args:
            start: Initial heights, such as those of the iteration before.
        """
        sides = source.detach().cpu().double().reshape(-1, len(self._inside)).mT
        initial = None
        if start is not None:
            initial = torch.where(self._inside, start.detach().cpu().double().flatten(), 0)
            initial[self._pixel] -= initial[self._root][self._component]
            initial = initial[:, None]
        rhs = self._centered(torch.where(self._inside[:, None], sides, 0)).contiguous()
        if self._factor is not None:
            found = self._factor.solve_values(rhs)
        else:
            found = solve_with_hierarchy(
                *self._cycles, rhs, self._tolerance, self._what, initial
            ).values
        return self._centered(found).mT.reshape(source.shape).to(source)

    @property
    def anchored(self) -> Bool[Tensor, " pixel"]:
        """Whether a pixel's height is determined: inside, and in no free component."""
        return self._inside.index_fill(0, self._pixel, False)

    def _free(
        self,
        right: Bool[Tensor, "height steps_right"],
        down: Bool[Tensor, "steps_down width"],
        anchored: Bool[Tensor, "height width"],
    ) -> None:
        """Find the connected components without anchor, but for single pixels."""
        index = torch.arange(anchored.numel()).view(anchored.shape)
        first = torch.cat([index[:, :-1][right], index[:-1][down]])
        second = torch.cat([index[:, 1:][right], index[1:][down]])
        label = graph_components(torch.stack([first, second], dim=1), anchored.numel()).long()
        known = torch.zeros(len(label) + 1, dtype=torch.bool)
        known[label[anchored.flatten()]] = True
        connected = torch.zeros(len(label), dtype=torch.bool)
        connected[first], connected[second] = True, True
        self._pixel = (connected & ~known[label]).nonzero()[:, 0]
        found, self._component = torch.unique(label[self._pixel], return_inverse=True)
        root = self._pixel.new_full((len(found),), len(label))
        self._root = root.scatter_reduce(0, self._component, self._pixel, "amin")
        self._size = torch.bincount(self._component, minlength=len(found)).double()

    def _centered(self, heights: Float[Tensor, "pixel side"]) -> Float[Tensor, "pixel side"]:
        """Subtract from each free component its mean."""
        total = heights.new_zeros(len(self._root), heights.shape[1])
        total = total.index_add(0, self._component, heights[self._pixel])
        mean = total / self._size[:, None]
        return heights.index_add(0, self._pixel, -mean[self._component])


def _compressed(
    right: Float[Tensor, "height steps_right"],
    down: Float[Tensor, "steps_down width"],
    diagonal: Float[Tensor, "height width"],
) -> csr_array:
    """Return the five-point stencil as compressed rows, without the entries that are zero."""
    height, width = diagonal.shape
    values = np.zeros((height, width, 5))
    values[1:, :, 0] = values[:-1, :, 4] = -down.numpy()
    values[:, 1:, 1] = values[:, :-1, 3] = -right.numpy()
    values[:, :, 2] = diagonal.numpy()
    kept = values != 0
    pixel = np.arange(height * width, dtype=np.int32).reshape(height, width, 1)
    neighbour = pixel + np.array([-width, -1, 0, 1, width], dtype=np.int32)
    starts = np.zeros(height * width + 1, dtype=np.int32)
    np.cumsum(kept.sum(axis=2).reshape(-1), out=starts[1:])
    return csr_array((values[kept], neighbour[kept], starts), shape=(height * width,) * 2)


def _times(weight: Float[Tensor, "..."], value: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """Multiply in float64, ignoring values without weight."""
    return weight.double() * torch.where(weight > 0, value, 0).double()


class _RasterSolve(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401 - torch gives contexts no usable type
        system: RasterSystem,
        weight_right: Float[Tensor, "height steps_right"],
        weight_down: Float[Tensor, "steps_down width"],
        anchor: Float[Tensor, "height width"],
        source: Float[Tensor, "*batch height width"],
    ) -> Float[Tensor, "*batch height width"]:
        heights = system.solve_values(source)
        ctx.system = system
        ctx.save_for_backward(weight_right, weight_down, anchor, heights)
        return heights

    @staticmethod
    def backward(
        ctx: Any,  # noqa: ANN401
        upstream: Float[Tensor, "*batch height width"],
    ) -> tuple[Float[Tensor, "..."] | None, ...]:
        weight_right, weight_down, anchor, heights = ctx.saved_tensors
        system: RasterSystem = ctx.system
        adjoint: Tensor = _RasterSolve.apply(  # type: ignore[no-untyped-call]
            system, weight_right, weight_down, anchor, upstream
        )
        into: list[Tensor | None] = [None, None, None]
        if any(ctx.needs_input_grad[1:4]):
            steps, adjoint_steps = differences(heights), differences(adjoint)
            anchored = system.anchored.view(anchor.shape).to(anchor.device)
            products = [
                steps[0] * adjoint_steps[0],
                steps[1] * adjoint_steps[1],
                heights * adjoint * anchored,
            ]
            into = [
                -product.reshape(-1, *given.shape).sum(dim=0).to(given)
                for product, given in zip(
                    products, (weight_right, weight_down, anchor), strict=True
                )
            ]
        return None, *into, adjoint
