r"""Weighted least squares on the differences of neighbouring pixels: a graph Laplacian.

.. math:: \min_z \sum_e w_e (z_{e+} - z_{e-} - g_e)^2 + \sum_i a_i (z_i - c_i)^2

over the edges ``e`` between a pixel and the next to the right or below. The matrix,
:math:`D^T W D + \mathrm{diag}(a)`, is a graph Laplacian with anchors. A mask is weights that
are zero: a pixel without edges and without anchor is outside, and gets 0.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.ground.geometry.topology import graph_components
from pimper_torch.ground.linalg.multigrid import Multigrid
from pimper_torch.ground.linalg.prepared import DEFAULT_TOLERANCE
from pimper_torch.ground.linalg.sparse import SparseCholesky
from pimper_torch.ground.shapes import Map
from pimper_torch.published.integrate import Heights, StepsDown, StepsRight, differences_transposed

# A factor takes twice as long to make as a hierarchy (0.17 s against 0.08 s) and a third as long
# to use; below it is as quick in all, and its solutions are exact.
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
        weight_right: StepsRight,
        weight_down: StepsDown,
        anchor: Map | None = None,
        *,
        tolerance: float = DEFAULT_TOLERANCE,
    ) -> None:
        if anchor is None:
            anchor = weight_right.new_zeros(weight_right.shape[0], weight_down.shape[1])
        self._given = weight_right, weight_down, anchor
        count = anchor.numel()
        pixel = torch.arange(count).view(anchor.shape)
        first = torch.cat([pixel[:, :-1].flatten(), pixel[:-1].flatten()])
        second = torch.cat([pixel[:, 1:].flatten(), pixel[1:].flatten()])
        weight = torch.cat([weight_right.flatten(), weight_down.flatten()]).cpu().double()
        connected = weight != 0
        first, second, weight = first[connected], second[connected], weight[connected]
        held = anchor.flatten().cpu().double()
        degree = weight.new_zeros(count).index_add(0, first, weight).index_add(0, second, weight)
        self._inside = degree.detach() + held.detach() != 0
        # Free components are those without anchor, but for single pixels.
        edges, anchored = torch.stack([first, second], dim=1), held.detach() > 0
        label = graph_components(edges, count).long()
        known = label[anchored].bincount(minlength=count + 1) > 0
        tied = edges.flatten().bincount(minlength=count) > 0
        self._pixel = (tied & ~known[label]).nonzero()[:, 0]
        free, self._component = torch.unique(label[self._pixel], return_inverse=True)
        root = self._pixel.new_full((len(free),), count)
        self._root = root.scatter_reduce(0, self._component, self._pixel, "amin")
        self._size = torch.bincount(self._component, minlength=len(free)).double()
        # Anchors of free components are zero and stay it.
        held = held.index_fill(0, self._pixel, 0.0)
        # Doubled at one pixel of each free component, so that the matrix is definite. With a
        # right-hand side of mean zero this fixes that pixel at 0 and changes nothing else.
        diagonal = torch.where(self._inside, degree + held, 1)
        diagonal = diagonal.index_add(0, self._root, diagonal[self._root])
        solver = SparseCholesky if count <= _CHOLESKY_PIXELS else Multigrid
        self._matrix = solver(
            torch.cat([first, second, pixel.flatten()]),
            torch.cat([second, first, pixel.flatten()]),
            torch.cat([-weight, -weight, diagonal]),
            count,
            "the integration",
            tolerance,
        )

    def solve(self, source: Heights) -> Heights:
        r"""Solve :math:`(D^T W D + \mathrm{diag}(a)) z = s`.

        Args:
            source: ``s``; ignored outside, and its mean over each free component.

        Differentiable in ``source`` and in all weights, any number of times, by one more solve.
        Anchors of free components get no gradient.

        Raises:
            SingularSystemError: A source or weights that are not finite.
        """
        sides = source.cpu().double().reshape(-1, len(self._inside)).mT
        rhs = self._centered(torch.where(self._inside[:, None], sides, 0))
        found = self._centered(self._matrix.solve(rhs))
        return found.mT.reshape(source.shape).to(source)

    def fit_steps(self, right: StepsRight, down: StepsDown, heights: Map | None = None) -> Map:
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

    def _centered(self, heights: Float[Tensor, "pixel side"]) -> Float[Tensor, "pixel side"]:
        """Subtract from each free component its mean."""
        total = heights.new_zeros(len(self._root), heights.shape[1])
        total = total.index_add(0, self._component, heights[self._pixel])
        mean = total / self._size[:, None]
        return heights.index_add(0, self._pixel, -mean[self._component])


def _times(weight: Float[Tensor, "..."], value: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    return weight.double() * torch.where(weight > 0, value, 0).double()
