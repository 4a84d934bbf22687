"""How strong a light is, ambient and directed, once it is known where it comes from."""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.photometry.robust import CAUCHY_TUNING, cauchy_weights, median_deviation
from pimper_torch.relighting.observed import Observed

# Ambient and directed strengths of every light and channel, and the mean loss.
Strengths = tuple[
    Float[Tensor, "light channel"], Float[Tensor, "light channel"], Float[Tensor, " light"]
]

_REWEIGHTED = 3
_LEAST_DEVIATION = 0.002  # half a level of eight bits


def loss_scale(seen: Observed) -> float:
    """Return the scale of Cauchy's loss, by a light of first order without any shadow."""
    basis = torch.cat([torch.ones_like(seen.radiance[:, :1]), seen.pixels.normals_world], dim=1)
    root = seen.weight.sqrt() * ~seen.saturated[:, None]
    residuals = []
    for channel in range(seen.radiance.shape[1]):
        rows = (root * seen.pixels.base_color)[:, channel, None] * basis
        values = (root * seen.radiance)[:, channel]
        light = torch.linalg.lstsq(rows, values[:, None], driver="gelsd").solution[:, 0]
        residuals.append(values - rows @ light)
    size = torch.stack(residuals).norm(dim=0)
    deviation = float(median_deviation(size, torch.ones_like(size, dtype=torch.bool)))
    return CAUCHY_TUNING * max(deviation, _LEAST_DEVIATION)


def fit_strengths(
    seen: Observed,
    diffuse: Float[Tensor, "*batch pixel #channel"],
    response: Float[Tensor, "light pixel #channel"],
    scale: float,
) -> Strengths:
    """Fit ambient and directed strength for every light, by reweighted least squares.

    Args:
        diffuse: Radiance under an ambient light of 1, one for all lights or one for each.
        response: Radiance under a directed light of strength 1.

    Returns:
        Both, neither below 0, and the mean loss.
    """
    base, radiance = diffuse, seen.radiance
    used = (~seen.saturated)[:, None].expand_as(response).float()
    robust = torch.ones_like(response[..., 0])
    for _ in range(_REWEIGHTED):
        weight = robust[..., None] * seen.weight * used
        aa, ab = (weight * base**2).sum(dim=1), (weight * base * response).sum(dim=1)
        bb = (weight * response**2).sum(dim=1)
        ay = (weight * base * radiance).sum(dim=1)
        by = (weight * response * radiance).sum(dim=1)
        ambient, directed = _non_negative(aa, ab, bb, ay, by)
        error = seen.errors(ambient[:, None] * base + directed[:, None] * response)
        used = (error != 0).float()
        size = (seen.weight * error**2).sum(dim=-1).sqrt()
        robust = cauchy_weights(size, torch.full_like(size[:1, :1], scale))
    return ambient, directed, -robust.log().mean(dim=1)


def _non_negative(
    aa: Tensor, ab: Tensor, bb: Tensor, ay: Tensor, by: Tensor
) -> tuple[Tensor, Tensor]:
    """Solve the normal equations of two unknowns, neither below 0."""
    tiny = torch.finfo(aa.dtype).tiny
    determinant = aa * bb - ab**2
    sound = determinant > 1e-6 * aa * bb
    determinant = torch.where(sound, determinant, 1)
    first, second = (bb * ay - ab * by) / determinant, (aa * by - ab * ay) / determinant
    alone, other = ay / aa.clamp_min(tiny), by / bb.clamp_min(tiny)
    both = sound & (first >= 0) & (second >= 0)
    # One of them is 0 at the best point that is allowed: the gain of each alone decides.
    larger = ay * alone >= by * other
    return (
        torch.where(both, first, torch.where(larger, alone, 0)),
        torch.where(both, second, torch.where(larger, 0, other)),
    )
