r"""Conventions for the bas-relief transformation: upright and rounded, and convex."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.single_view.factorization.bas_relief import BasRelief


def rounded_relief(
    shading: Float[Tensor, "3 pixel"],
    weight: Float[Tensor, " pixel"],
    mask: Bool[Tensor, "height width"],
) -> BasRelief:
    r"""Return the transformation that makes a surface upright on average, and as deep as a ball.

    :math:`\sum w b_x b_z = \sum w b_y b_z = 0` and
    :math:`\sum w (b_x^2 + b_y^2) = \sum w b_z^2`, as on the image of a sphere of even albedo; of
    the two signs of ``lambda`` the convex one, whose normals point outwards on average. It is
    a convention: the data do not determine it.

    Args:
        shading: Of a surface, up to a bas-relief transformation, ``b_z < 0``, raster order.
        weight: Not negative.

    Differentiable; degenerate for a plane, where ``lambda`` is 1.
    """
    w = weight.to(shading)
    x, y, z = shading
    depth = (w * z * z).sum().clamp_min(torch.finfo(shading.dtype).tiny)
    mu, nu = (w * x * z).sum() / depth, (w * y * z).sum() / depth
    square = (w * ((x - mu * z) ** 2 + (y - nu * z) ** 2)).sum()
    flat = square <= torch.finfo(shading.dtype).tiny * depth
    lam = torch.where(flat, 1, (depth / torch.where(flat, 1, square)).sqrt())
    lam = lam * bulge(torch.stack([x - mu * z, y - nu * z]), w, mask)
    return BasRelief(mu=lam * mu, nu=lam * nu, lam=lam)


def convex(
    relief: BasRelief,
    shading: Float[Tensor, "3 pixel"],
    weight: Float[Tensor, " pixel"],
    mask: Bool[Tensor, "height width"],
) -> BasRelief:
    """Choose the convex one of a transformation and its mirror image, which fit equally well.

    Args:
        shading: It is applied to this, raster order.
        weight: Not negative.
    """
    mu, nu, lam = (part.to(shading) for part in (relief.mu, relief.nu, relief.lam))
    found = BasRelief(mu=mu, nu=nu, lam=lam)
    sign = bulge(found.on_shading(shading)[:2], weight.to(shading), mask)
    return BasRelief(mu=sign * mu, nu=sign * nu, lam=sign * lam)


def bulge(
    sideways: Float[Tensor, "2 pixel"],
    weight: Float[Tensor, " pixel"],
    mask: Bool[Tensor, "height width"],
) -> Float[Tensor, ""]:
    """Return whether normals point outwards on average (1) or inwards (-1).

    Args:
        sideways: The parts of shading along x and y, uncorrelated with z.
        weight: Not negative.
    """
    rows, columns = torch.nonzero(mask, as_tuple=True)
    position = torch.stack([columns, rows]).to(sideways)
    total = weight.sum().clamp_min(torch.finfo(sideways.dtype).tiny)
    position = position - (weight * position).sum(dim=1, keepdim=True) / total
    return torch.where((weight * position * sideways).sum() < 0, -1.0, 1.0).to(sideways)
