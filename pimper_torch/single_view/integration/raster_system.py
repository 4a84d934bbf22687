r"""Weighted least squares on the differences of neighbouring pixels: a graph Laplacian.

.. math:: \min_z \sum_e w_e (z_{e+} - z_{e-} - g_e)^2 + \sum_i a_i (z_i - c_i)^2

over the edges ``e`` between a pixel and the next to the right or below. The matrix,
:math:`D^T W D + \mathrm{diag}(a)`, is a graph Laplacian with anchors. A mask is weights that
are zero: a pixel without edges and without anchor is outside, and gets 0.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.geometry.topology import graph_components
from pimper_torch.linalg.hierarchy import Hierarchy
from pimper_torch.linalg.multigrid import Iterate, solve_with_hierarchy
from pimper_torch.linalg.prepared import DEFAULT_TOLERANCE
from pimper_torch.linalg.sparse import SparseCholesky
from pimper_torch.paper.integrate import differences, differences_transposed, solve_poisson


@dataclass(frozen=True, slots=True, kw_only=True)
class FreeComponents:
    """The connected components without anchor, and their pixels.

    Attributes:
        pixel: Indices of the pixels of all free components, row by row.
        root: One pixel of each component.
        size: Pixels of each component.
    """

    pixel: Int[Tensor, " member"]
    component: Int[Tensor, " member"]
    root: Int[Tensor, " component"]
    size: Float[Tensor, " component"]

    def centered(self, heights: Float[Tensor, " pixel"]) -> Float[Tensor, " pixel"]:
        """Subtract from each free component its mean. Its own transpose; differentiable."""
        if not len(self.root):
            return heights
        part = heights[self.pixel]
        mean = heights.new_zeros(len(self.root)).index_add(0, self.component, part) / self.size
        return heights.index_add(0, self.pixel, -mean[self.component])

    def rooted(self, heights: Float[Tensor, " pixel"]) -> Float[Tensor, " pixel"]:
        """Subtract from each free component the height of its root."""
        part = heights[self.pixel] - heights[self.root][self.component]
        return heights.index_copy(0, self.pixel, part)

    def pinned(self, diagonal: Float[Tensor, " pixel"]) -> Float[Tensor, " pixel"]:
        """Double the diagonal at one pixel of each free component: the matrix becomes definite.

        With a right-hand side of mean zero this fixes that pixel at 0 and changes nothing else.
        """
        return diagonal.index_add(0, self.root, diagonal[self.root])


def free_components(
    right: Bool[Tensor, "height steps_right"],
    down: Bool[Tensor, "steps_down width"],
    anchored: Bool[Tensor, "height width"],
) -> FreeComponents:
    """Find the components without anchor, but for single pixels.

    Args:
        right: Whether a pixel and the next in its row are connected.
        down: Whether it and the one below are.
        anchored: Whether a pixel's height is known.
    """
    label = _labels(right, down, anchored.shape)
    connected = torch.zeros_like(anchored)
    connected[:, 1:] |= right
    connected[:, :-1] |= right
    connected[1:] |= down
    connected[:-1] |= down
    count = int(label.max()) + 1 if label.numel() else 0
    pinned = anchored.new_zeros(count).index_put(
        (label[anchored.reshape(-1)],), anchored.new_ones(())
    )
    pixel = (connected.reshape(-1) & ~pinned[label]).nonzero()[:, 0]
    found, component = torch.unique(label[pixel], return_inverse=True)
    root = pixel.new_full((len(found),), label.numel())
    root = root.scatter_reduce(0, component, pixel, "amin")
    size = torch.bincount(component, minlength=len(found)).double()
    return FreeComponents(pixel=pixel, component=component, root=root, size=size)


def _labels(
    right: Bool[Tensor, "height steps_right"],
    down: Bool[Tensor, "steps_down width"],
    shape: tuple[int, ...],
) -> Int[Tensor, " pixel"]:
    count = shape[0] * shape[1]
    if bool(right.all()) and bool(down.all()):
        return torch.zeros(count, dtype=torch.long, device=right.device)
    pixel = torch.arange(count, dtype=torch.int32).reshape(shape)
    across, along = right.cpu(), down.cpu()
    one = torch.cat([pixel[:, :-1][across], pixel[:-1][along]])
    other = torch.cat([pixel[:, 1:][across], pixel[1:][along]])
    return graph_components(torch.stack([one, other], dim=1), count).long().to(right.device)


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


Method = Literal["auto", "cholesky", "multigrid", "cosine"]

# Here a factor takes twice as long to make as a hierarchy (0.17 s against 0.08 s) and a third
# as long to use; below it is as quick in all, and its solutions are exact.
_CHOLESKY_PIXELS = 20_000


class RasterSystem:
    r"""The matrix :math:`D^T W D + \mathrm{diag}(a)` of a raster, prepared for many solves.

    Args:
        weight_right: Of the step from each pixel to the next in its row; not negative.
        anchor: ``a``, of each pixel's known height; not negative. None for no anchors.
        method: ``"cholesky"``: exact, on the CPU; ``"multigrid"``: conjugate gradients, memory
            and time grow with the pixels only; ``"cosine"``: one division, for full rectangles
            with equal weights. ``"auto"`` takes the quickest that can.
        tolerance: Of multigrid: of the error, in the energy norm, relative.

    Raises:
        InputError: Weights that are negative or not finite; ``"cosine"`` where they differ.

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
        method: Method = "auto",
        tolerance: float = DEFAULT_TOLERANCE,
        what: str = "the raster",
    ) -> None:
        self._requested, self._tolerance, self._what = method, tolerance, what
        if anchor is None:
            anchor = weight_right.new_zeros(weight_right.shape[0], weight_down.shape[1])
        self._given = (weight_right, weight_down, anchor)
        self._refuse_unusable()
        with torch.no_grad():
            right, down, anchors = (part.detach().double().contiguous() for part in self._given)
            row_sum = _row_sums(right, down) + anchors
            self._inside = row_sum > 0
            self._components = free_components(right > 0, down > 0, anchors > 0)
            diagonal = torch.where(self._inside, row_sum, 1).reshape(-1)
            diagonal = self._components.pinned(diagonal).view(row_sum.shape)
            self._stencil = Stencil(right=right, down=down, diagonal=diagonal)
            self._solver = self._prepared(anchors)

    @property
    def method(self) -> str:
        """The method that is used."""
        return self._solver.method

    @property
    def anchored(self) -> Bool[Tensor, "height width"]:
        """Whether a pixel's height is determined: inside, and in no free component."""
        fixed = self._inside.reshape(-1).index_fill(0, self._components.pixel, False)
        return fixed.view(self._inside.shape)

    def solve(
        self, source: Float[Tensor, "*batch height width"]
    ) -> Float[Tensor, "*batch height width"]:
        r"""Solve :math:`(D^T W D + \mathrm{diag}(a)) z = s`.

        Args:
            source: ``s``; ignored outside, and its mean over each free component.

        Differentiable in ``source`` and in all weights, any number of times, by one more solve
        with the same factor or hierarchy. Anchors of free components get no gradient.

        Raises:
            SingularSystemError: No convergence, with iterations and residual.
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

    def iterate(
        self,
        source: Float[Tensor, "height width"],
        start: Float[Tensor, "height width"] | None = None,
    ) -> Iterate:
        """Solve once, and give the iterations; not differentiable.

        Args:
            start: Initial heights, such as those of the iteration before.
        """
        with torch.no_grad():
            diagonal, groups = self._stencil.diagonal, self._components
            source_inside = torch.where(self._inside, source.detach().to(diagonal), 0)
            rhs = groups.centered(source_inside.reshape(-1)).view(diagonal.shape)
            initial = None
            if start is not None:
                initial = torch.where(self._inside, start.detach().to(diagonal), 0)
                initial = groups.rooted(initial.reshape(-1)).view(diagonal.shape)
            found = self._solver.iterate(rhs, initial)
            return dataclasses.replace(found, values=groups.centered(found.values))

    def _refuse_unusable(self) -> None:
        right, down, anchor = (tuple(part.shape) for part in self._given)
        height, width = anchor
        if right != (height, width - 1) or down != (height - 1, width):
            raise InputError(
                f"{self._what}: weights of shape {right} to the right, {down} down and {anchor} "
                "of anchors make no raster; (height, width - 1), (height - 1, width) and "
                "(height, width) are needed."
            )
        names = ("steps to the right", "steps down", "anchors")
        for name, part in zip(names, self._given, strict=True):
            bad = ~(part.detach().isfinite() & (part.detach() >= 0))
            if bool(bad.any()):
                first = bad.nonzero()[0].tolist()
                raise InputError(
                    f"{self._what}: {int(bad.sum())} weights of {name} are negative or not "
                    f"finite (the first at row {first[0]}, column {first[1]}); each must be 0 or "
                    "more. Give unknown steps weight 0."
                )

    def _prepared(self, anchor: Float[Tensor, "height width"]) -> RasterSolver:
        stencil = self._stencil
        equal = all(
            bool((part > 0).all() & (part == part[:1, :1]).all())
            for part in (stencil.right, stencil.down)
        ) and bool((anchor == anchor[:1, :1]).all())
        if self._requested == "cosine" and not equal:
            raise InputError(
                f"{self._what}: the cosine transform needs weights that are the same everywhere "
                "and not 0. Use another method, or 'auto'."
            )
        if self._requested == "cosine" or (self._requested == "auto" and equal):
            return CosineRaster(stencil, float(anchor[0, 0]))
        small = anchor.numel() <= _CHOLESKY_PIXELS and anchor.device.type == "cpu"
        if self._requested == "cholesky" or (self._requested == "auto" and small):
            return CholeskyRaster(stencil, self._what)
        return MultigridRaster(stencil, self._tolerance, self._what)


def _row_sums(
    right: Float[Tensor, "height steps_right"], down: Float[Tensor, "steps_down width"]
) -> Float[Tensor, "height width"]:
    """Add up the weights of each pixel's edges."""
    pad = torch.nn.functional.pad
    across = pad(right, (1, 0)) + pad(right, (0, 1))
    return across + pad(down, (0, 0, 1, 0)) + pad(down, (0, 0, 0, 1))


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
        rasters = source.reshape(-1, *anchor.shape)
        found = [system.iterate(raster).values for raster in rasters]
        heights = torch.stack(found).reshape(source.shape).to(source) if found else source.clone()
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
            products = [
                steps[0] * adjoint_steps[0],
                steps[1] * adjoint_steps[1],
                heights * adjoint * system.anchored,
            ]
            into = [
                -product.reshape(-1, *given.shape).sum(dim=0).to(given)
                for product, given in zip(
                    products, (weight_right, weight_down, anchor), strict=True
                )
            ]
        return None, *into, adjoint
