r"""Agreement of views on one point of the surface, under the light of each.

A view ``g`` should show :math:`\rho s_g`, with :math:`s_g` what its light makes of albedo 1
there. The albedo that fits all views best is found by re-weighted means, and its robust residual
is the cost of the point.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def inconsistency(
    radiance: Float[Tensor, "sample view hypothesis"],
    shading: Float[Tensor, "sample view"],
    seen: Bool[Tensor, "sample view"],
    scale: Float[Tensor, " sample"],
    iterations: int = 2,
) -> Float[Tensor, "sample hypothesis"]:
    r"""Return the robust cost of every hypothesis.

    .. math:: C = \sum_g \tfrac12 \log(1 + (x_g - \rho s_g)^2 / c^2)

    with the albedo that is the median of those of single views, then so many re-weighted means.

    Args:
        radiance: What each view shows of the sample if the hypothesis holds.
        shading: Of albedo 1, the same for all hypotheses; positive where seen.
        seen: Views that take part; the same for all hypotheses, as costs of different sets
            could not be compared.
        scale: ``c``, in units of radiance.

    Differentiable in radiance, shading and scale, through the iterations of the albedo.
    """
    s = torch.where(seen, shading, 1)[..., None]
    taken, per_scale = seen[..., None].to(radiance), 1 / scale[:, None, None]
    single = torch.where(seen[..., None], radiance / s, torch.nan)
    albedo = single.nanmedian(dim=1, keepdim=True).values.nan_to_num(nan=0.0)
    for _ in range(iterations):
        residual = (radiance - albedo * s) * per_scale
        lit = taken * s / (1 + residual.square())
        square = (lit * s).sum(dim=1, keepdim=True)
        albedo = (lit * radiance).sum(dim=1, keepdim=True) / torch.where(square > 0, square, 1)
    residual = (radiance - albedo * s) * per_scale
    return 0.5 * (taken * torch.log1p(residual.square())).sum(dim=1)
