"""Where the costs of evenly spaced hypotheses are least, finer than their steps."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def parabola_minimum(
    cost: Float[Tensor, "*batch hypothesis"],
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Bool[Tensor, "*batch"]]:
    """Fit a parabola to the least cost and the two beside it.

    Returns:
        The place of the minimum in steps from the first hypothesis, the parabola's second
        derivative there (per squared step), and whether there is such a minimum: a cost at
        an end of the range is none, for the range may end before it.

    Differentiable in the costs; which hypothesis is least is constant.

    >>> cost = torch.tensor([[4.0, 1.0, 0.0, 1.0]])
    >>> parabola_minimum(cost)
    (tensor([2.]), tensor([2.]), tensor([True]))
    """
    last = cost.shape[-1] - 1
    best = cost.detach().argmin(dim=-1, keepdim=True)
    interior = (best > 0) & (best < last)
    centre = best.clamp(1, last - 1)
    before, here, after = (cost.gather(-1, centre + step)[..., 0] for step in (-1, 0, 1))
    curvature = before - 2 * here + after
    bent = interior[..., 0] & (curvature > 0)
    aside = (before - after) / (2 * torch.where(bent, curvature, 1))
    place = torch.where(bent, centre[..., 0] + aside.clamp(-0.5, 0.5), best[..., 0].to(cost))
    return place, torch.where(bent, curvature, 0), bent


def posterior_variance(
    cost: Float[Tensor, "*batch hypothesis"], curvature: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch"]:
    r"""Give the variance of the place, in squared steps, if costs are negative log likelihoods.

    That of the hypotheses, :math:`p_k \propto e^{-C_k}`, and that of the parabola between
    them. Several minima that suit nearly as well make it wide, which the curvature of the best
    alone does not tell.

    Args:
        cost: Of evenly spaced hypotheses.
        curvature: Second derivative at the minimum; where it is 0 the variance is infinite.

    >>> posterior_variance(torch.tensor([[100.0, 0.0, 100.0]]), torch.tensor([200.0]))
    tensor([0.0050])
    """
    steps = torch.arange(cost.shape[-1], device=cost.device, dtype=cost.dtype)
    fraction = torch.softmax(-cost, dim=-1)
    mean = (fraction * steps).sum(dim=-1, keepdim=True)
    spread = (fraction * (steps - mean).square()).sum(dim=-1)
    bent = curvature > 0
    return torch.where(bent, spread + 1 / torch.where(bent, curvature, 1), torch.inf)
