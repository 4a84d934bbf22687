"""Rank-four factors upgraded to the photometric cone."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.photometry.quadratics import diagonal, outer
from pimper_torch.records import Record
from pimper_torch.single_view.factorization.ambiguity import minkowski


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Upgraded(Record):
    """Factors with the same product, near the cone up to a Lorentz transformation.

    Attributes:
        lights: ``L``.
        shading: ``N``, with albedo positive for most samples.
        lorentzian: Whether the quadric has the cone's signature; if not, the factors are not
            near a cone.
    """

    lights: Float[Tensor, "patch view 4"]
    shading: Float[Tensor, "patch 4 sample"]
    lorentzian: Bool[Tensor, " patch"]


def upgrade_to_cone(
    lights: Float[Tensor, "patch view 4"],
    shading: Float[Tensor, "patch 4 sample"],
    weight: Float[Tensor, "patch sample"],
) -> Upgraded:
    r"""Find the linear map that takes the shading vectors nearest to the cone, and apply it.

    All lie on a quadric :math:`s^\top Q s = 0`; ``Q`` is the least eigenvector of their quadratic
    monomials, and :math:`Q = H^\top \eta H` gives the matrix ``H``. With noise, or normals
    that vary too little, Q may not have the signature (1, 3), which ``lorentzian`` reports; the
    eigenvalue of the rarer sign is then that of albedo.
    """
    S, L = shading.double(), lights.double()
    moment = (S * weight[:, None]) @ S.mT
    values, vectors = torch.linalg.eigh(moment)
    whiten = vectors * values.clamp_min(1e-12 * values[:, -1:] + 1e-300).rsqrt()[:, None, :]
    S, L = whiten.mT @ S, L @ torch.linalg.pinv(whiten).mT
    size = S.norm(dim=1, keepdim=True)
    unit = S / size.clamp_min(1e-12)
    monomials = outer(unit) * (weight > 0)[:, None]
    double = torch.full_like(monomials[0, :, :1], 2.0)
    double[diagonal(4)] = 1
    monomials = monomials * double
    least = torch.linalg.eigh(monomials @ monomials.mT).eigenvectors[..., 0]
    rows, columns = torch.triu_indices(4, 4)
    Q = least.new_zeros(len(least), 4, 4)
    Q[:, rows, columns] = least
    Q[:, columns, rows] = least
    values, vectors = torch.linalg.eigh(Q)
    # Ascending: one positive at the end, or one negative at the front.
    front = values[:, 1] > 0
    flipped = front | ((values[:, 2] > 0) & (values[:, 0].abs() > values[:, 3]))
    values = torch.where(flipped[:, None], -values.flip(1), values)
    vectors = torch.where(flipped[:, None, None], vectors.flip(2), vectors)
    lorentzian = (values[:, 3] > 0) & (values[:, 2] < 0)
    order = [3, 0, 1, 2]
    roots = values[:, order].abs().clamp_min(1e-6).sqrt()
    H = roots[..., None] * vectors[:, :, order].mT
    S, L = H @ S, L @ torch.linalg.inv(H)
    sign = torch.where((weight * S[:, 0].sign()).sum(dim=1) < 0, -1.0, 1.0)[:, None, None]
    eta = minkowski(S)
    # A negative time axis is mirrored by -1; space axes are left to the alignment.
    mirror = torch.where(sign < 0, -torch.eye(4, dtype=S.dtype, device=S.device), eta @ eta)
    return Upgraded(
        lights=(L @ mirror).to(lights), shading=(mirror @ S).to(shading), lorentzian=lorentzian
    )
