r"""Integration that lets depth jump: which steps between pixels the surface really takes.

.. math:: \min_x \sum_e D_e\, \phi_\sigma\!\left(\frac{x_b - x_a}{u_e} - s_e\right)

over steps ``e`` that normals predict as ``s_e``, with Geman and McClure's :math:`\phi`, whose
influence ends: a step across an edge of depth is given up instead of bending the surface on
both sides. That problem has many minima. It is solved by graduated non-convexity: from plain
least squares :math:`\sigma` falls to its last value, and the weights then settle; every linear
system is solved to the end, so where that leads does not depend on how.

At a crease, and where something ends in front of something else, the slope along a step
changes on it by more than beside it, and what normals predict there is wrong by up to that
change. Where the slope across a step changes so, both sides rise differently and meet in one
point at most. Such steps prove nothing, and are not asked: they, and all others that were
given up, only tie. Parts that hang together by ties alone, whose places normals do not tell,
so lie where the mean of their border says.

Source: Black & Rangarajan, IJCV 19(1), 1996, for the loss and its graduation; the division in
continuous parts and borders follows Milano, Chung, Ott & Siegwart, 2025, though here parts are
what the weights leave together and never fixed. Kinks and twists are ours.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.config import require
from pimper_torch.linalg.multigrid import Iterate
from pimper_torch.paper.poisson import differences, differences_transposed
from pimper_torch.progress import report
from pimper_torch.records import Convergence, Record, StopCause
from pimper_torch.single_view.integration.rasters import Method, RasterSystem
from pimper_torch.single_view.integration.steps import Steps

# The first scale, in pixels, and by how much each round divides it.
_FIRST_SCALE, _NARROWER = 3.0, 3.0

# Of the linear systems' solutions, in their energy; what remains is far below any scale.
_TOLERANCE = 1e-6

# Once the scale is at its last value weights move little, and a hierarchy is kept until it
# needs more cycles than this.
_MANY_CYCLES = 25

# A deviation is this many times the median of absolute residuals.
_PER_MEDIAN = 1.4826

Pair = tuple[Tensor, Tensor]


@dataclass(frozen=True, slots=True, kw_only=True)
class DiscontinuityConfig:
    """When a step is given up.

    Attributes:
        scale_px: Residual at which a step keeps a quarter of its weight, in widths of a
            pixel at the surface's depth.
        noise_scales: The scale is at least so many deviations of the residuals, so that noisy
            normals do not tear the surface.
        kink: A step whose slope changes by so much more than on the steps beside it is not
            asked about jumps; about the tangent of the angle of a crease.
        twist: Likewise of the slope across the step, which no crease along the raster has.
        tie: Weight of steps that are given up or not asked.
        tolerance: Mean change of the weights at which they have settled.
        max_iterations: Linear systems at most.
    """

    scale_px: float = 0.3
    noise_scales: float = 6.0
    kink: float = 2.0
    twist: float = 1.0
    tie: float = 1e-4
    tolerance: float = 5e-4
    max_iterations: int = 40

    def __post_init__(self) -> None:
        for name in ("scale_px", "noise_scales", "kink", "twist", "tolerance"):
            value = getattr(self, name)
            require(value > 0, name, value, "above 0")
        require(0 < self.tie < 1, "tie", self.tie, "in (0, 1)")
        require(self.max_iterations >= 1, "max_iterations", self.max_iterations, "1 or more")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Continuity(Record):
    """Which steps the surface takes.

    Attributes:
        right: Weight in [0, 1] of each step to the right: 1 continuous, ``tie`` given up, 0
            outside.
        down: Likewise.
        convergence: Of the weights; the residual is that of continuous steps, in pixels.
    """

    right: Float[Tensor, "height steps_right"]
    down: Float[Tensor, "steps_down width"]
    convergence: Convergence


def find_discontinuities(
    steps: Steps,
    weight_right: Float[Tensor, "height steps_right"],
    weight_down: Float[Tensor, "steps_down width"],
    anchor: Float[Tensor, "height width"] | None,
    heights: Float[Tensor, "height width"] | None,
    config: DiscontinuityConfig,
    method: Method = "auto",
) -> Continuity:
    """Find out which steps the surface takes.

    Args:
        steps: Wanted by the normals.
        weight_right: ``D``, zero outside, in units of the squared unknown's inverse.
        weight_down: Likewise.
        anchor: Of pixels whose unknown is given.
        heights: The given ones.
        config: When a step is given up.
        method: Of the linear systems.

    Constant to autograd.
    """
    with torch.no_grad():
        inside = weight_right > 0, weight_down > 0
        calm = (
            (steps.kink_right < config.kink) & (steps.twist_right < config.twist),
            (steps.kink_down < config.kink) & (steps.twist_down < config.twist),
        )
        asked = steps.known_right & calm[0] & inside[0], steps.known_down & calm[1] & inside[1]
        fraction = (
            torch.where(asked[0], 1.0, config.tie) * inside[0],
            torch.where(asked[1], 1.0, config.tie) * inside[1],
        )
        system, solution = None, None
        scale, narrowed, cause = _FIRST_SCALE, False, StopCause.LIMIT
        for taken in range(1, config.max_iterations + 1):
            weights = weight_right * fraction[0], weight_down * fraction[1]
            if system is None or solution is None:
                system = RasterSystem(
                    *weights, anchor, method=method, tolerance=_TOLERANCE, what="the integration"
                )
            else:
                keep = narrowed and solution.iterations <= _MANY_CYCLES
                system = system.refreshed(*weights, anchor, keep=keep)
            solution = _solved(system, steps, weights, anchor, heights, solution)
            apart = _residuals(steps, solution.values.reshape(steps.inside.shape))
            smallest = _last_scale(apart, asked, config)
            narrowed = scale <= smallest
            scale = max(scale, smallest)
            before = fraction
            fraction = (
                _fraction(apart[0], asked[0], inside[0], scale, config.tie),
                _fraction(apart[1], asked[1], inside[1], scale, config.tie),
            )
            report(taken, config.max_iterations)
            if narrowed and _mean_change(before, fraction, inside) < config.tolerance:
                cause = StopCause.CONVERGED
                break
            scale = max(scale / _NARROWER, smallest)
        return Continuity(
            right=fraction[0],
            down=fraction[1],
            convergence=Convergence(
                iterations=torch.tensor([taken]),
                residual=_deviation(apart, fraction)[None],
                cause=torch.tensor([int(cause)]),
            ),
        )


def _solved(
    system: RasterSystem,
    steps: Steps,
    weights: Pair,
    anchor: Tensor | None,
    heights: Tensor | None,
    start: Iterate | None,
) -> Iterate:
    wanted = steps.wanted
    source = differences_transposed(weights[0] * wanted[0], weights[1] * wanted[1])
    if anchor is not None and heights is not None:
        source = source + anchor * heights
    return system.iterate(source, None if start is None else start.values.reshape(source.shape))


def _residuals(steps: Steps, found: Float[Tensor, "height width"]) -> Pair:
    """Tell by how many pixels' widths the surface leaves the wanted steps."""
    right, down = differences(found)
    return right / steps.unit_right - steps.right, down / steps.unit_down - steps.down


def _fraction(
    residual: Float[Tensor, "row column"],
    asked: Bool[Tensor, "row column"],
    inside: Bool[Tensor, "row column"],
    scale: float,
    tie: float,
) -> Float[Tensor, "row column"]:
    """Give the fraction of its weight that a step keeps."""
    geman_mcclure = (1 + (residual / scale).square()) ** -2
    return torch.where(asked, geman_mcclure, 0).clamp_min(tie) * inside


def _last_scale(apart: Pair, asked: tuple[Tensor, Tensor], config: DiscontinuityConfig) -> float:
    some = torch.cat([apart[0][asked[0]], apart[1][asked[1]]])
    deviation = _PER_MEDIAN * float(some.abs().median()) if len(some) else 0.0
    return max(config.scale_px, config.noise_scales * deviation)


def _mean_change(before: Pair, after: Pair, inside: tuple[Tensor, Tensor]) -> float:
    moved = (after[0] - before[0]).abs().sum() + (after[1] - before[1]).abs().sum()
    return float(moved) / max(1, int(inside[0].sum()) + int(inside[1].sum()))


def _deviation(apart: Pair, fraction: Pair) -> Float[Tensor, ""]:
    square = (fraction[0] * apart[0].square()).sum() + (fraction[1] * apart[1].square()).sum()
    return (square / (fraction[0].sum() + fraction[1].sum()).clamp_min(1)).sqrt()
