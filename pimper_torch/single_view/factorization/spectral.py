"""Rank-four factors upgraded to the photometric cone."""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.photometry.quadratics import diagonal, outer, unpacked


def upgrade_to_cone(
    lights: Float[Tensor, "view 4"],
    shading: Float[Tensor, "4 sample"],
    weight: Float[Tensor, " sample"],
) -> tuple[Float[Tensor, "view 4"], Float[Tensor, "4 sample"]]:
    r"""Find the linear map that takes the shading vectors nearest to the cone, and apply it.

    All lie on a quadric :math:`s^\top Q s = 0`; ``Q`` is the least eigenvector of their quadratic
    monomials, and :math:`Q = H^\top \eta H` gives the matrix ``H``. With noise, or normals
    that vary too little, Q may not have the signature (1, 3); the eigenvalue of the rarer sign is
    then that of albedo.

    Returns:
        Factors with the same product, near the cone up to a Lorentz transformation; albedo is
        positive for most samples.
    """
    S, L = shading.double(), lights.double()
    values, vectors = torch.linalg.eigh((S * weight) @ S.mT)
    whiten = vectors * values.clamp_min(1e-12 * values[-1] + 1e-300).rsqrt()
    S, L = whiten.mT @ S, L @ torch.linalg.pinv(whiten).mT
    unit = S / S.norm(dim=0).clamp_min(1e-12)
    double = torch.full((10, 1), 2.0).to(S)
    double[diagonal(4)] = 1
    monomials = double * outer(unit) * (weight > 0)
    least = torch.linalg.eigh(monomials @ monomials.mT).eigenvectors[:, :1]
    values, vectors = torch.linalg.eigh(unpacked(least, 4)[0])
    # Ascending: one positive at the end, or one negative at the front.
    if values[1] > 0 or (values[2] > 0 and values[0].abs() > values[3]):
        values, vectors = -values.flip(0), vectors.flip(1)
    order = [3, 0, 1, 2]
    roots = values[order].abs().clamp_min(1e-6).sqrt()
    H = roots[:, None] * vectors[:, order].mT
    S, L = H @ S, L @ torch.linalg.inv(H)
    # A negative time axis is mirrored with the others; space axes are left to the alignment.
    sign = torch.where((weight * S[0].sign()).sum() < 0, -1.0, 1.0)
    return (sign * L).to(lights), (sign * S).to(shading)
