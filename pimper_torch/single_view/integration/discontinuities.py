r"""Discontinuity-preserving integration: detection of continuous steps between pixels.

.. math:: \min_x \sum_e D_e\, \phi_\sigma\!\left(\frac{x_b - x_a}{u_e} - s_e\right)

over steps ``e`` with slopes ``s_e`` from the normals. Geman and McClure's loss :math:`\phi` is
redescending: a step across a depth discontinuity is rejected instead of deforming the surface on
both sides. The problem has many minima and is solved by graduated non-convexity: starting from
least squares, :math:`\sigma` decreases to its final value, then the weights converge. Every linear
system is solved to convergence, so the result does not depend on the solver.

At a crease or an occlusion boundary, the slope along a step changes by more than on the adjacent
steps, and the predicted step is wrong by up to that change (kink). Where the slope across a step
changes so (twist), both sides meet in at most one point. Such steps are not tested. They and the
rejected steps keep a small weight, which aligns separate components in the mean of their border.

Source: Black & Rangarajan, IJCV 19(1), 1996, for the loss and its graduation; the partition into
continuous components and borders follows Milano, Chung, Ott & Siegwart, 2025, but components
follow from the weights and are never fixed. Kinks and twists are ours.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.paper.integrate import StepsDown, StepsRight, differences
from pimper_torch.records import Convergence, Record, StopCause
from pimper_torch.records.shapes import Map
from pimper_torch.runtime.progress import report
from pimper_torch.single_view.integration.raster_system import RasterSystem
from pimper_torch.single_view.integration.steps import Steps, joined

# The final scale, the residual at which a step keeps a quarter of its weight: in pixel widths at
# the surface's depth; at least in deviations of residuals, so noise causes no discontinuities.
_SCALE_PX, _NOISE_SCALES = 0.3, 6.0

# Maximum kink of a tested step, about the tangent of a crease's angle; and maximum twist, which
# creases along the raster do not have.
_KINK, _TWIST = 2.0, 1.0

# Weight of steps that are rejected or not tested.
_TIE = 1e-4

# Mean change of the weights at convergence, and maximum number of linear systems.
_CHANGE, _MAX_ITERATIONS = 5e-4, 40


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class ContinuousSteps(Record):
    """Weights of the steps between pixels.

    Attributes:
        right: Weight of each step to the right: 1 continuous, 1e-4 rejected, 0 outside.
        convergence: Convergence of the weights; the residual of continuous steps is in pixels.
    """

    right: StepsRight
    down: StepsDown
    convergence: Convergence


def find_discontinuities(
    steps: Steps, weight: Float[Tensor, " step"], known_weight: Map | None, heights: Map | None
) -> ContinuousSteps:
    """Return the weights of continuous steps; constant to autograd.

    Args:
        weight: ``D``, zero outside, in units of the inverse squared unknown.
        known_weight: Weights of the known unknowns in ``heights``.
    """
    with torch.no_grad():
        inside = weight > 0
        tested = inside & steps.reliable & (steps.kink < _KINK) & (steps.twist < _TWIST)
        fraction = torch.where(tested, 1.0, _TIE) * inside
        scale, cause = 3.0, StopCause.LIMIT  # pixels
        for iteration in range(1, _MAX_ITERATIONS + 1):
            system = RasterSystem(*steps.split(weight * fraction), known_weight, tolerance=1e-6)
            right, down = differences(system.fit_steps(*steps.target, heights))
            residual = joined(right, down) / steps.unit - steps.slope
            deviation = 1.4826 * float(residual[tested].abs().median()) if tested.any() else 0.0
            smallest = max(_SCALE_PX, _NOISE_SCALES * deviation)
            narrowed = scale <= smallest
            scale = max(scale, smallest)
            geman_mcclure = (1 + (residual / scale).square()) ** -2
            before = fraction
            fraction = torch.where(tested, geman_mcclure, 0).clamp_min(_TIE) * inside
            report(iteration, _MAX_ITERATIONS)
            change = float((fraction - before).abs().sum()) / max(1, int(inside.sum()))
            if narrowed and change < _CHANGE:
                cause = StopCause.CONVERGED
                break
            scale = max(scale / 3, smallest)
        square = (fraction * residual.square()).sum() / fraction.sum().clamp_min(1)
        right, down = steps.split(fraction)
        return ContinuousSteps(
            right=right,
            down=down,
            convergence=Convergence(
                iterations=torch.tensor([iteration]),
                residual=square.sqrt()[None],
                cause=torch.tensor([int(cause)]),
            ),
        )
