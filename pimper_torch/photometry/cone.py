r"""The photometric manifold :math:`\{\rho\,(1, n) : \rho \ge 0, \lVert n \rVert = 1\}`.

It is a cone of light in four dimensions: the time axis is albedo, the space axes the normal.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def project_to_cone(shading: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    r"""Replace each shading vector by the nearest one a Lambertian surface can produce.

    Albedo :math:`\rho` and unit normal :math:`n` reach the images only as
    :math:`(b_0, b) = (\rho, \rho n)`, which ties :math:`b_0` to :math:`\lVert b \rVert`.
    Factorization ignores the tie; this restores it in the least-squares sense, with
    :math:`\rho = \max(0, b_0 + \lVert b \rVert) / 2` and :math:`n = b / \lVert b \rVert`.

    Args:
        shading: ``(b_0, b_x, b_y, b_z)`` in the patch frame; albedo in image units, up
            to the scale all patches share.

    Returns:
        Vectors on the cone. One without direction (``b = 0``), or nearest to the apex,
        becomes zero: that pixel has no normal, and the caller masks it.

    Differentiable except at ``b = 0`` and ``b_0 = -|b|``; masked vectors get zero gradient.

    Source: Basri, Jacobs & Kemelmacher, IJCV 72(3), 2007, for the tie; the closed form
    is ours, checked in ``test_cone.py``.

    >>> project_to_cone(torch.tensor([1.0, 0.0, 0.0, -3.0]))
    tensor([ 2.,  0.,  0., -2.])
    """
    scalar, vector = shading[..., :1], shading[..., 1:]
    directed = (vector != 0).any(dim=-1, keepdim=True)
    safe = torch.where(directed, vector, 1)  # the norm has no gradient at zero
    length = _length(safe)
    albedo = torch.where(directed, (scalar + length).clamp_min(0) / 2, 0)
    normal = torch.where(directed, safe / length, 0)
    return torch.cat([albedo, albedo * normal], dim=-1)


def split_shading(
    shading: Float[Tensor, "*batch 4"],
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
    """Read albedo and unit normal off vectors on the cone.

    A vector without direction gives the normal zero. Differentiable away from the apex.
    """
    vector = shading[..., 1:]
    directed = (vector != 0).any(dim=-1, keepdim=True)
    safe = torch.where(directed, vector, 1)
    return shading[..., 0], torch.where(directed, safe / _length(safe), 0)


def _length(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 1"]:
    # Component by component in memory, where torch's norm takes twice as long.
    x, y, z = vector.unbind(dim=-1)
    return (x * x + y * y + z * z).sqrt()[..., None]


def tangents(
    normals: Float[Tensor, "*batch 3"],
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]:
    """Give two unit vectors that span, with each unit normal, a right-handed frame.

    Continuous except where ``n_z`` changes sign, which viewer-facing normals never do.

    Source: Duff et al., Building an orthonormal basis, revisited, JCGT 6(1), 2017.
    """
    x, y, z = normals.unbind(dim=-1)
    sign = torch.where(z >= 0, 1.0, -1.0).to(normals.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack([1 + sign * x * x * a, sign * b, -sign * x], dim=-1)
    second = torch.stack([b, sign + y * y * a, -y], dim=-1)
    return first, second


def tangent_columns(shading: Float[Tensor, "*batch 4 sample"]) -> list[Tensor]:
    r"""Span the tangent space of the cone at each column :math:`\rho (1, n)`.

    Returns:
        Three arrays of columns: :math:`(1, n)`, which changes albedo, and
        :math:`(0, t_1), (0, t_2)`, which turn the normal by :math:`1/\rho` a unit.
    """
    _, normal = split_shading(shading.mT)
    first, second = tangents(normal)
    still = torch.zeros_like(first[..., :1])
    return [
        torch.cat([torch.ones_like(still), normal], dim=-1).mT,
        torch.cat([still, first], dim=-1).mT,
        torch.cat([still, second], dim=-1).mT,
    ]
