r"""Weighted least squares on the differences of neighbouring pixels: a graph Laplacian.

.. math:: \min_z \sum_e w_e (z_{e+} - z_{e-} - g_e)^2 + \sum_i a_i (z_i - c_i)^2

over the edges ``e`` from a pixel to the next one to the right or below; :math:`c_i` are known
heights. The matrix, :math:`D^T W D + \mathrm{diag}(a)`, is a graph Laplacian with a diagonal. A
mask is given by zero weights: a pixel without edges and known height is outside, and gets 0.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.geometry.topology import graph_components
from pimper_torch.linalg.multigrid import Multigrid
from pimper_torch.linalg.prepared import DEFAULT_TOLERANCE
from pimper_torch.linalg.sparse import SparseCholesky
from pimper_torch.paper.integrate import Heights, StepsDown, StepsRight, differences_transposed
from pimper_torch.records.shapes import Map

# A factorization takes twice as long to compute as a multigrid hierarchy (0.17 s and 0.08 s), and a
# third as long to apply. Below this size it is as fast in total, and its solutions are exact.
_CHOLESKY_PIXELS = 20_000


class RasterSystem:
    r"""The matrix :math:`D^T W D + \mathrm{diag}(a)` of a raster, for any number of solves.

    Args:
        weight_right: Of the step from each pixel to the next in its row; finite, not negative.
        known_weight: ``a``, weight of each pixel's known height; not negative, ``None`` for zero.
        tolerance: Relative error of a solution in the energy norm.

    A free component, which is connected and has no known height, has mean 0; the mean of its
    right-hand side is ignored. Weights may vary over ten orders, with holes, islands and single
    pixels. Heights are computed in float64, with the right-hand side's device and dtype.

    >>> system = RasterSystem(torch.ones(2, 1), torch.ones(1, 2))
    >>> system.fit_steps(torch.ones(2, 1), torch.zeros(1, 2))
    tensor([[-0.5000,  0.5000],
            [-0.5000,  0.5000]])
    """

    def __init__(
        self,
        weight_right: StepsRight,
        weight_down: StepsDown,
        known_weight: Map | None = None,
        *,
        tolerance: float = DEFAULT_TOLERANCE,
    ) -> None:
        if known_weight is None:
            known_weight = weight_right.new_zeros(weight_right.shape[0], weight_down.shape[1])
        self._weights = weight_right, weight_down, known_weight
        count = known_weight.numel()
        pixel = torch.arange(count).view(known_weight.shape)
        first = torch.cat([pixel[:, :-1].flatten(), pixel[:-1].flatten()])
        second = torch.cat([pixel[:, 1:].flatten(), pixel[1:].flatten()])
        weight = torch.cat([weight_right.flatten(), weight_down.flatten()]).cpu().double()
        connected = weight != 0
        first, second, weight = first[connected], second[connected], weight[connected]
        fixed = known_weight.flatten().cpu().double()
        degree = weight.new_zeros(count).index_add(0, first, weight).index_add(0, second, weight)
        self._inside = degree.detach() + fixed.detach() != 0
        # Free components: no known height, and more than a single pixel.
        edges, known = torch.stack([first, second], dim=1), fixed.detach() > 0
        label = graph_components(edges, count).long()
        has_known = label[known].bincount(minlength=count + 1) > 0
        has_edge = edges.flatten().bincount(minlength=count) > 0
        self._pixel = (has_edge & ~has_known[label]).nonzero()[:, 0]
        free, self._component = torch.unique(label[self._pixel], return_inverse=True)
        root = self._pixel.new_full((len(free),), count)
        self._root = root.scatter_reduce(0, self._component, self._pixel, "amin")
        self._size = torch.bincount(self._component, minlength=len(free)).double()
        # No gradient of the weights in free components, which are zero.
        fixed = fixed.index_fill(0, self._pixel, 0.0)
        # Doubled at one pixel of each free component, so that the matrix is definite. With a
        # right-hand side of mean zero this fixes that pixel at 0 and changes nothing else.
        diagonal = torch.where(self._inside, degree + fixed, 1)
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
        r"""Return the solution of :math:`(D^T W D + \mathrm{diag}(a)) z = s`.

        Args:
            source: ``s``; ignored outside. Its mean over each free component is also ignored.

        Differentiable in ``source`` and all weights to any order, by one more solve each; weights
        ``a`` in free components have no gradient.

        Raises:
            SingularSystemError: A source or weights that are not finite.
        """
        sides = source.cpu().double().reshape(-1, len(self._inside)).mT
        rhs = self._centered(torch.where(self._inside[:, None], sides, 0))
        solution = self._centered(self._matrix.solve(rhs))
        return solution.mT.reshape(source.shape).to(source)

    def fit_steps(self, right: StepsRight, down: StepsDown, heights: Map | None = None) -> Map:
        """Return the least-squares heights for given steps and known heights.

        Args:
            right: Target steps to the right; ignored where the weight is zero, even if NaN.
            heights: Known heights; ignored where the weight is zero. ``None`` for zero.
        """
        weight_right, weight_down, known_weight = self._weights
        source = differences_transposed(_times(weight_right, right), _times(weight_down, down))
        if heights is not None:
            source = source + _times(known_weight, heights)
        return self.solve(source).to(right)

    def _centered(self, heights: Float[Tensor, "pixel side"]) -> Float[Tensor, "pixel side"]:
        """Return the heights minus the mean of each free component."""
        total = heights.new_zeros(len(self._root), heights.shape[1])
        total = total.index_add(0, self._component, heights[self._pixel])
        mean = total / self._size[:, None]
        return heights.index_add(0, self._pixel, -mean[self._component])


def _times(weight: Float[Tensor, "..."], value: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    return weight.double() * torch.where(weight > 0, value, 0).double()
