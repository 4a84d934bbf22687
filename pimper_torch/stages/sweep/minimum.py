"""Sub-step minimum of the costs of evenly spaced hypotheses, and its variance."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.records.shapes import Scalars

Costs = Float[Tensor, "*batch hypothesis"]


def parabola_minimum(
    cost: Costs, prior: Costs | None = None
) -> tuple[Scalars, Scalars, Bool[Tensor, "*batch"]]:
    """Fit a parabola to the least cost and its two neighbours.

    Args:
        prior: Added to the costs only for selecting the least one.

    Returns:
        The position of the minimum in steps from the first hypothesis, the parabola's second
        derivative there (per squared step), and whether the minimum is interior: the least cost
        does not count at an end of the range, because the minimum may be beyond it.

    Differentiable in the costs; the index of the least cost is constant.

    >>> cost = torch.tensor([[4.0, 1.0, 0.0, 1.0]])
    >>> parabola_minimum(cost)
    (tensor([2.]), tensor([2.]), tensor([True]))
    """
    last = cost.shape[-1] - 1
    selection = cost if prior is None else cost + prior
    best = selection.detach().argmin(dim=-1, keepdim=True)
    interior = (best > 0) & (best < last)
    centre = best.clamp(1, last - 1)
    before, least, after = (cost.gather(-1, centre + step)[..., 0] for step in (-1, 0, 1))
    curvature = before - 2 * least + after
    bent = interior[..., 0] & (curvature > 0)
    shift = (before - after) / (2 * torch.where(bent, curvature, 1))
    position = torch.where(bent, centre[..., 0] + shift.clamp(-0.5, 0.5), best[..., 0].to(cost))
    return position, torch.where(bent, curvature, 0), bent


def posterior_variance(cost: Costs, position: Scalars, curvature: Scalars) -> Scalars:
    r"""Return the posterior variance of the minimum's position, in squared steps.

    Costs are interpreted as negative log likelihoods, :math:`p_k \propto e^{-C_k}`. The variance is
    that of the parabola at the minimum, :math:`1 / C''`, plus the excess of the variance over all
    hypotheses above that of this parabola at the same hypotheses. Gaussian costs thus give the
    variance of the Gaussian, and other minima that are nearly as low add their spread.

    Args:
        position: Of the minimum, in steps from the first hypothesis.
        curvature: Second derivative there; if it is 0, the variance is infinite.

    >>> cost = torch.tensor([[100.0, 0.0, 100.0]])
    >>> posterior_variance(cost, torch.tensor([1.0]), torch.tensor([200.0]))
    tensor([0.0050])
    """
    steps = torch.arange(cost.shape[-1], device=cost.device, dtype=cost.dtype)
    parabola = 0.5 * curvature[..., None] * (steps - position[..., None]).square()
    beyond = (_variance(cost) - _variance(parabola)).clamp_min(0)
    bent = curvature > 0
    return torch.where(bent, beyond + 1 / torch.where(bent, curvature, 1), torch.inf)


def _variance(cost: Costs) -> Scalars:
    """Return the variance of the hypotheses' index under their likelihoods."""
    steps = torch.arange(cost.shape[-1], device=cost.device, dtype=cost.dtype)
    likelihood = torch.softmax(-cost, dim=-1)
    mean = (likelihood * steps).sum(dim=-1, keepdim=True)
    return (likelihood * (steps - mean).square()).sum(dim=-1)
