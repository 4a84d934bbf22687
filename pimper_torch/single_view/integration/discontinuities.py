r"""Discontinuity-preserving integration: which steps between pixels are continuous.

.. math:: \min_x \sum_e D_e\, \phi_\sigma\!\left(\frac{x_b - x_a}{u_e} - s_e\right)

over steps ``e`` that normals predict as ``s_e``, with Geman and McClure's :math:`\phi`, which
redescends: a step across a depth discontinuity is rejected instead of deforming the surface on
both sides. That problem has many minima. It is solved by graduated non-convexity: from plain
least squares :math:`\sigma` falls to its final value, then the weights converge; every linear
system is solved to convergence, so that the result does not depend on the solver.

At a crease, and at an occlusion boundary, the slope along a step changes by more than on the
steps beside it, and the predicted step is wrong by up to that change. Where the slope across a
step changes so, both sides meet in one point at most. Such steps are not tested: they, and all
rejected ones, keep a small weight. Components that are connected by such weights alone,
whose relative depth normals do not determine, are so aligned in the mean of their border.

Source: Black & Rangarajan, IJCV 19(1), 1996, for the loss and its graduation; the partition into
continuous components and borders follows Milano, Chung, Ott & Siegwart, 2025, though here
components follow from the weights and are never fixed. Kinks and twists are ours.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.ground.shapes import Map
from pimper_torch.published.integrate import StepsDown, StepsRight, differences
from pimper_torch.records import Convergence, Record, StopCause
from pimper_torch.runtime.progress import report
from pimper_torch.single_view.integration.raster_system import RasterSystem
from pimper_torch.single_view.integration.steps import Steps, joined

# The final scale: residual at which a step keeps a quarter of its weight, in widths of a pixel at
# the surface's depth, and the least in deviations of the residuals, so that noisy normals make no
# discontinuities.
_SCALE_PX, _NOISE_SCALES = 0.3, 6.0

# Maximum kink of a step that is tested, about the tangent of a crease's angle; likewise of the
# slope across the step, which no crease along the raster has.
_KINK, _TWIST = 2.0, 1.0

# Weight of steps that are rejected or not tested.
_TIE = 1e-4

# Mean change of the weights at convergence, and linear systems at most.
_CHANGE, _MAX_ITERATIONS = 5e-4, 40


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Continuity(Record):
    """The continuous steps.

    Attributes:
        right: Weight in [0, 1] of each step to the right: 1 continuous, 1e-4 rejected, 0
            outside.
        convergence: Of the weights; the residual is that of continuous steps, in pixels.
    """

    right: StepsRight
    down: StepsDown
    convergence: Convergence


def find_discontinuities(
    steps: Steps, weight: Float[Tensor, " step"], anchor: Map | None, heights: Map | None
) -> Continuity:
    """Find the continuous steps; constant to autograd.

    Args:
        weight: ``D``, zero outside, in units of the squared unknown's inverse.
        anchor: Of pixels whose unknown is given.
    """
    with torch.no_grad():
        inside = weight > 0
        tested = inside & steps.reliable & (steps.kink < _KINK) & (steps.twist < _TWIST)
        fraction = torch.where(tested, 1.0, _TIE) * inside
        scale, cause = 3.0, StopCause.LIMIT  # pixels
        for taken in range(1, _MAX_ITERATIONS + 1):
            system = RasterSystem(*steps.split(weight * fraction), anchor, tolerance=1e-6)
            right, down = differences(system.fit_steps(*steps.target, heights))
            residual = joined(right, down) / steps.unit - steps.slope
            deviation = 1.4826 * float(residual[tested].abs().median()) if tested.any() else 0.0
            smallest = max(_SCALE_PX, _NOISE_SCALES * deviation)
            narrowed = scale <= smallest
            scale = max(scale, smallest)
            geman_mcclure = (1 + (residual / scale).square()) ** -2
            before = fraction
            fraction = torch.where(tested, geman_mcclure, 0).clamp_min(_TIE) * inside
            report(taken, _MAX_ITERATIONS)
            change = float((fraction - before).abs().sum()) / max(1, int(inside.sum()))
            if narrowed and change < _CHANGE:
                cause = StopCause.CONVERGED
                break
            scale = max(scale / 3, smallest)
        square = (fraction * residual.square()).sum() / fraction.sum().clamp_min(1)
        right, down = steps.split(fraction)
        return Continuity(
            right=right,
            down=down,
            convergence=Convergence(
                iterations=torch.tensor([taken]),
                residual=square.sqrt()[None],
                cause=torch.tensor([int(cause)]),
            ),
        )
