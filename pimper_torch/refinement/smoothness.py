r"""What a slope off its facet's trend costs: in proportion to its square, or to its size.

Quadratic smoothness :math:`\int G |\nabla S - J|^2` rounds a crease, for it makes one great
slope dearer than many small ones. Robust smoothness takes

.. math:: \psi(d) = 2 \epsilon^2 \big( \sqrt{1 + d^2 / \epsilon^2} - 1 \big),
    \qquad d = |\nabla S - J|

instead (Charbonnier's function): :math:`d^2` as long as the slope is off its facet's trend J
by less than :math:`\epsilon`, total variation :math:`2 \epsilon d` beyond. It is convex, so
that there is one surface of least energy; that surface is reached by solving the quadratic
problem again and again with :math:`\psi'(d) / 2d = 1 / \sqrt{1 + d^2 / \epsilon^2}` as the
weight of each face, every time nearer.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.records import StopCause


def charbonnier_weight(deviation: Float[Tensor, "*batch"], scale: float) -> Float[Tensor, "*batch"]:
    r"""Give :math:`1 / \sqrt{1 + d^2 / \epsilon^2}`: 1 for small deviations, then falling.

    Source: Charbonnier, Blanc-Féraud, Aubert, Barlaud: Two deterministic half-quadratic
    regularization algorithms for computed imaging, ICIP 1994.

    >>> charbonnier_weight(torch.tensor([0.0, 1.0, 10.0]), 1.0)
    tensor([1.0000, 0.7071, 0.0995])
    """
    return (1 + (deviation / scale).square()).rsqrt()


def reweighted(
    solve: Callable[[Float[Tensor, " face"]], Float[Tensor, "vertex 3"]],
    deviation: Callable[[Float[Tensor, "vertex 3"]], Float[Tensor, " face"]],
    start: Float[Tensor, " face"],
    *,
    scale: float,
    tolerance: Float[Tensor, ""],
    limit: int,
) -> tuple[Float[Tensor, "vertex 3"], int, StopCause]:
    """Minimise the robust energy by quadratic solves, each with the weights of the one before.

    Args:
        solve: The surface of least quadratic energy for weights of the faces.
        deviation: How far off its facet's trend the slope of each face is.
        start: Weights to begin with.
        scale: Epsilon.
        tolerance: It has converged when no vertex moves more than this, in the mean square.
        limit: Of the solves.

    Returns:
        The surface, how many solves it took, and why they ended.

    Differentiable through the last solve, whose weights are constants.
    """
    with torch.no_grad():
        weight = start
        found = solve(weight)
        solves, settled = 1, False
        while solves < limit and not settled:
            weight = charbonnier_weight(deviation(found), scale)
            before, found = found, solve(weight)
            moved = (found - before).square().sum(dim=-1).mean().sqrt()
            solves, settled = solves + 1, bool(moved <= tolerance)
    cause = StopCause.CONVERGED if settled else StopCause.LIMIT
    return solve(weight) if torch.is_grad_enabled() else found, solves, cause
