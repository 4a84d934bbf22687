r"""How well views agree on one place of the surface, under the light that each of them has.

A view ``g`` should show :math:`\rho s_g`, with :math:`s_g` what its light makes of albedo 1
there. The albedo that suits all views best is found in closed form, and what it leaves is the
cost of the place.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def inconsistency(
    radiance: Float[Tensor, "patch view hypothesis *raster"],
    shading: Float[Tensor, "patch view *raster"],
    seen: Bool[Tensor, "patch view *raster"],
    scale: Float[Tensor, " patch"],
    rounds: int = 2,
) -> Float[Tensor, "patch hypothesis *raster"]:
    r"""Give the robust cost of every hypothesis.

    .. math:: C = \min_\rho \sum_g \tfrac12 \log(1 + (x_g - \rho s_g)^2 / c^2)

    the albedo by so many re-weighted means, the first with equal weights.

    Args:
        radiance: Where each view has the sample if the hypothesis holds.
        shading: Of albedo 1, the same for all hypotheses.
        seen: Views that take part; the same for all hypotheses, as costs of different sets
            could not be compared.
        scale: ``c``, in units of radiance.
        rounds: Of the albedo.

    Differentiable in radiance and shading.
    """
    trailing = (1,) * (radiance.ndim - 1)
    s = torch.where(seen, shading, 0)[:, :, None]
    per_scale = 1 / scale.reshape(-1, *trailing)
    weight = seen[:, :, None].to(radiance)
    residual = radiance
    for again in range(rounds):
        if again:
            weight = seen[:, :, None] / (1 + (residual * per_scale).square())
        lit = weight * s
        square = (lit * s).sum(dim=1)
        albedo = (lit * radiance).sum(dim=1) / torch.where(square > 0, square, 1)
        residual = radiance - albedo[:, None] * s
    relative = (residual * per_scale).square()
    return 0.5 * torch.where(seen[:, :, None], torch.log1p(relative), 0).sum(dim=1)
