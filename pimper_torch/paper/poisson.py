r"""From slopes to heights on batches of small rasters.

All of it is the least-squares problem :math:`\min_z \sum w |\nabla z - g|^2` with forward
differences and nothing fixed at the border. With equal weights the cosine basis (the Fourier
basis of the mirrored raster) turns it into a division, frequency by frequency; with weights
that division is the preconditioner of conjugate gradients.

The transforms are products with the basis: on rasters of 30 to 120 samples a side, the size
of templates, they are 3 to 10 times faster than FFTs, and at 500 still within a factor 1.6.
"""

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.linalg.conjugate_gradients import conjugate_gradients


def cosine_basis(size: int, like: Float[Tensor, "..."]) -> Float[Tensor, "{size} {size}"]:
    """Return the orthonormal cosines (DCT-II), one a row, with device and dtype of ``like``."""
    frequency = torch.arange(size, device=like.device, dtype=like.dtype)
    basis = (math.pi / size * frequency[:, None] * (frequency + 0.5)).cos()
    basis = basis * math.sqrt(2 / size)
    return torch.cat([basis[:1] * math.sqrt(0.5), basis[1:]])


def differences(
    heights: Float[Tensor, "*batch height width"],
) -> tuple[Float[Tensor, "*batch height steps_right"], Float[Tensor, "*batch steps_down width"]]:
    """Return the steps to the right and down."""
    return heights.diff(dim=-1), heights.diff(dim=-2)


def differences_transposed(
    right: Float[Tensor, "*batch height steps_right"],
    down: Float[Tensor, "*batch steps_down width"],
) -> Float[Tensor, "*batch height width"]:
    """Apply the transpose of :func:`differences`: minus the divergence."""
    pad = torch.nn.functional.pad
    across = pad(right, (1, 0)) - pad(right, (0, 1))
    return across + pad(down, (0, 0, 1, 0)) - pad(down, (0, 0, 0, 1))


def solve_poisson(
    source: Float[Tensor, "*batch height width"],
    weight_right: float = 1.0,
    weight_down: float = 1.0,
    anchor: float = 0.0,
) -> Float[Tensor, "*batch height width"]:
    r"""Solve :math:`(D^T W D + a) z = s`, D the steps of :func:`differences`.

    Args:
        source: ``s``. Without anchor no ``z`` can produce its mean, which is ignored; ``z``
            then has mean zero.
        anchor: ``a`` of all samples, not negative.

    Differentiable in ``source``.
    """
    height, width = source.shape[-2:]
    rows, cols = cosine_basis(height, source), cosine_basis(width, source)
    across = weight_down * _stiffness(height, source)[:, None]
    stiffness = across + weight_right * _stiffness(width, source) + anchor
    # No height answers to the mean; dividing it by infinity removes it.
    stiffness = stiffness.masked_fill(stiffness == 0, torch.inf)
    return rows.mT @ ((rows @ source @ cols.mT) / stiffness) @ cols


def integrate_steps(
    right: Float[Tensor, "*batch height steps_right"],
    down: Float[Tensor, "*batch steps_down width"],
) -> Float[Tensor, "*batch height width"]:
    """Find the heights, of mean zero, whose steps come nearest to those given.

    Steps that belong to a height field give it back exactly, a tilted plane included: the
    basis does not force the borders to meet, as that of the periodic raster would.

    Source: Frankot & Chellappa, PAMI 10(4), 1988, in the cosine basis; Simchony, Chellappa &
    Shao, PAMI 12(5), 1990, for the discrete operator.
    """
    return solve_poisson(differences_transposed(right, down))


def integrate_weighted(
    right: Float[Tensor, "patch height steps_right"],
    down: Float[Tensor, "patch steps_down width"],
    weight_right: Float[Tensor, "patch height steps_right"],
    weight_down: Float[Tensor, "patch steps_down width"],
    iterations: int,
    tolerance: float = 1e-7,
) -> Float[Tensor, "patch height width"]:
    """Find the heights, of mean zero, whose steps come nearest where the weights are large.

    Conjugate gradients start at :func:`integrate_steps` and are preconditioned by it. Only
    the ratios of the weights matter; where they vary by more than some 1e4, what lies in the
    light part is left near the start.

    Args:
        weight_right: Of ``right``, not negative.
        weight_down: Of ``down``.
        iterations: Limit; 0 gives :func:`integrate_steps`.
        tolerance: Stops when all residuals are this small next to the source.

    Differentiable in steps and weights by one more solve with the same limit, so gradients
    are as exact as the solution.
    """
    start = integrate_steps(right, down)
    if iterations == 0:
        return start
    source = differences_transposed(weight_right * right, weight_down * down)
    found: Tensor = _Weighted.apply(  # type: ignore[no-untyped-call]
        weight_right, weight_down, source, start.detach(), iterations, tolerance
    )
    return found


def _stiffness(size: int, like: Float[Tensor, "..."]) -> Float[Tensor, " {size}"]:
    frequency = torch.arange(size, device=like.device, dtype=like.dtype)
    return 4 * (math.pi / (2 * size) * frequency).sin() ** 2


class _Weighted(torch.autograd.Function):
    """Solve D^T W D z = s; differentiable through the adjoint equation."""

    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401 - torch gives contexts no usable type
        weight_right: Float[Tensor, "patch height steps_right"],
        weight_down: Float[Tensor, "patch steps_down width"],
        source: Float[Tensor, "patch height width"],
        start: Float[Tensor, "patch height width"],
        iterations: int,
        tolerance: float,
    ) -> Float[Tensor, "patch height width"]:
        heights = _solve_weighted(weight_right, weight_down, source, start, iterations, tolerance)
        ctx.save_for_backward(weight_right, weight_down, heights)
        ctx.limits = (iterations, tolerance)
        return heights

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(
        ctx: Any,  # noqa: ANN401
        upstream: Float[Tensor, "patch height width"],
    ) -> tuple[Float[Tensor, "..."] | None, ...]:
        weight_right, weight_down, heights = ctx.saved_tensors
        wanted = upstream - upstream.mean(dim=(-2, -1), keepdim=True)
        start = solve_poisson(wanted)
        adjoint = _solve_weighted(weight_right, weight_down, wanted, start, *ctx.limits)
        right, down = differences(heights)
        adjoint_right, adjoint_down = differences(adjoint)
        return -right * adjoint_right, -down * adjoint_down, adjoint, None, None, None


def _solve_weighted(
    weight_right: Float[Tensor, "patch height steps_right"],
    weight_down: Float[Tensor, "patch steps_down width"],
    source: Float[Tensor, "patch height width"],
    start: Float[Tensor, "patch height width"],
    iterations: int,
    tolerance: float,
) -> Float[Tensor, "patch height width"]:
    def product(heights: Float[Tensor, "patch height width"]) -> Float[Tensor, "..."]:
        right, down = differences(heights)
        return differences_transposed(weight_right * right, weight_down * down)

    found, _, _ = conjugate_gradients(
        product,
        solve_poisson,
        source,
        start=start,
        dims=(-2, -1),
        tolerance=tolerance,
        max_iterations=iterations,
    )
    return found
