"""Compare derivatives of autograd with finite differences of the same function.

A stage that selects (a view, a face, valid samples) has jumps, and one that interpolates has kinks:
no derivative exists there. Finite differences detect both: those of two step sizes disagree, or
forward and backward ones. Such elements are counted and excluded. Where finite differences agree,
autograd must agree with them.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.records import Record

# Central differences of two step sizes that differ by more than this fraction saw a jump; forward
# and backward ones a kink.
_JUMP = 0.01

# Number of rounding errors in a function's value.
_ROUNDINGS = 16

# A direction is uninformative if more than this fraction of an output's elements jump.
_MAX_JUMPS = 0.5

Tensors = Mapping[str, Tensor]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class DerivativeCheck(Record):
    """Directional derivatives of one output by one input.

    Attributes:
        analytic: ``w . (J d)`` by autograd, for every weight ``w`` and direction ``d``.
        numeric: The same by central differences.
        smooth: Directions in which not too many elements jump or bend.
        jumped: Fraction of the output's elements that jump or bend, over all directions.
    """

    analytic: Float[Tensor, "weight direction"]
    numeric: Float[Tensor, "weight direction"]
    smooth: Bool[Tensor, " direction"]
    jumped: float

    @property
    def ratios(self) -> Float[Tensor, " ratio"]:
        """Analytic over numeric; 1 where both vanish."""
        analytic, numeric = self.analytic[:, self.smooth], self.numeric[:, self.smooth]
        ratios = analytic / torch.where(numeric == 0, torch.nan, numeric)
        return torch.where((analytic == 0) & (numeric == 0), 1, ratios).flatten()

    @property
    def ratio(self) -> float:
        """All of analytic over numeric, by least squares; NaN if every direction jumps.

        Single ratios are far off where a sum nearly vanishes; this one is not.
        """
        analytic, numeric = self.analytic[:, self.smooth], self.numeric[:, self.smooth]
        if analytic.numel() == 0:
            return float("nan")
        square = numeric.square().sum()
        if float(square) == 0:
            return 1.0 if float(analytic.abs().max()) == 0 else float("inf")
        return float((analytic * numeric).sum() / square)

    @property
    def median(self) -> float:
        """Of the ratios; NaN if every direction jumps."""
        ratios = self.ratios
        return float(ratios.median()) if len(ratios) else float("nan")

    @property
    def spread(self) -> float:
        """Largest distance of a ratio from 1; NaN if every direction jumps."""
        ratios = self.ratios
        return float((ratios - 1).abs().max()) if len(ratios) else float("nan")


def check_derivatives(
    function: Callable[[Tensors], Tensors],
    inputs: Tensors,
    generator: torch.Generator,
    *,
    scales: Mapping[str, float] | None = None,
    directions: int = 3,
    weights: int = 2,
    steps: tuple[float, float] = (1e-6, 1e-7),
) -> dict[tuple[str, str], DerivativeCheck]:
    """Compare autograd with central differences, for every input and output of a function.

    Args:
        function: From named tensors to named tensors; deterministic.
        inputs: In float64. Entries that are zero throughout a tensor of ``scales`` are moved, too.
        scales: Length of a unit step of each input, per element; the root mean square of its
            elements where not given.
        weights: Random sums of each output's elements; 0 for one sum a direction, of the absolute
            differences, in which nothing cancels.
        steps: The two sizes, in scales. Derivatives are those of the smaller one.

    Returns:
        By input and output.
    """
    scales = dict(scales or {})
    sizes = {
        name: scales.get(name, float(value.square().mean().sqrt()) or 1.0)
        for name, value in inputs.items()
    }
    paths = {
        name: sizes[name] * torch.randn(directions, *value.shape, generator=generator).to(value)
        for name, value in inputs.items()
    }
    centre = {key: value.detach() for key, value in function(_leaves(inputs)).items()}
    moving = {
        name: [_differences(function, inputs, name, path, steps, centre) for path in paths[name]]
        for name in inputs
    }
    live = _leaves(inputs)
    found = function(live)
    checks = {}
    for output, values in found.items():
        jumps = {
            name: torch.stack([jumps[output] for _, jumps in each]) for name, each in moving.items()
        }
        smooth = {name: jump.double().mean(dim=1) <= _MAX_JUMPS for name, jump in jumps.items()}
        jumping = torch.stack([jumps[name][smooth[name]].any(dim=0) for name in inputs]).any(dim=0)
        sums = torch.randn(weights, values.numel(), generator=generator).to(values)
        sums = torch.where(jumping, 0, sums)
        grads = [_gradients(values, some, live) for some in sums]
        for name in inputs:
            numeric = torch.stack([fine[output].flatten() for fine, _ in moving[name]])
            # A jump elsewhere may be infinite.
            numeric = torch.where(jumping, 0, numeric)
            if weights == 0:
                sums = numeric.sign()
                grads = [_gradients(values, some, {name: live[name]}) for some in sums]
            analytic = torch.stack([grad[name].flatten() for grad in grads])
            analytic = analytic @ paths[name].reshape(directions, -1).mT
            none = analytic.abs() <= _rounding(values.detach(), steps[1]) * values.numel() ** 0.5
            checks[name, output] = DerivativeCheck(
                analytic=torch.where(none & ~numeric.any(dim=1), 0, analytic),
                numeric=sums @ numeric.mT,
                smooth=smooth[name],
                jumped=float(jumps[name].double().mean()),
            )
    return checks


def _leaves(inputs: Tensors) -> dict[str, Tensor]:
    return {name: value.clone().requires_grad_() for name, value in inputs.items()}


def _differences(
    function: Callable[[Tensors], Tensors],
    inputs: Tensors,
    name: str,
    path: Tensor,
    steps: tuple[float, float],
    centre: Tensors,
) -> tuple[dict[str, Tensor], dict[str, Bool[Tensor, " element"]]]:
    """Return central differences of all outputs along a path, and elements that jump or bend."""

    def at(step: float) -> dict[str, Tensor]:
        found = function(_leaves({**inputs, name: inputs[name] + step * path}))
        return {key: value.detach() for key, value in found.items()}

    central = []
    for step in steps:
        after, before = at(step), at(-step)
        central.append({key: (after[key] - before[key]) / (2 * step) for key in centre})
    coarse, fine = central
    jumping = {}
    for key in centre:
        bend = (after[key] - 2 * centre[key] + before[key]) / steps[1]
        size = torch.maximum(coarse[key].abs(), fine[key].abs()).flatten()
        off = torch.maximum((coarse[key] - fine[key]).abs(), bend.abs()).flatten()
        floor = _rounding(centre[key], steps[1])
        jumping[key] = ~(off <= _JUMP * (size + size.median()) + floor)
        fine[key] = torch.where(fine[key].abs() <= floor, 0, fine[key])
    return fine, jumping


def _rounding(values: Tensor, step: float) -> Tensor:
    """Return the rounding error of a difference of equal values, over a step."""
    return _ROUNDINGS * torch.finfo(values.dtype).eps * values.abs().max() / step


def _gradients(values: Tensor, some: Tensor, live: Tensors) -> dict[str, Tensor]:
    if not values.requires_grad:
        return {name: torch.zeros_like(value) for name, value in live.items()}
    total = (values.flatten() * some).sum()
    found = torch.autograd.grad(total, list(live.values()), retain_graph=True, allow_unused=True)
    return {
        name: torch.zeros_like(value) if grad is None else grad
        for (name, value), grad in zip(live.items(), found, strict=True)
    }
