r"""Calibrated photometric stereo: normals and albedo under known point lights.

:math:`x_{vc} = \rho_c\, l_v^\top n`: one normal for all colours, an albedo for each.

Source: Woodham, Photometric method for determining surface orientation from multiple images,
Optical Engineering 19(1), 1980.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.photometry.quadratics import PackedCholesky, outer, unpacked
from pimper_torch.records import Record
from pimper_torch.single_view.photometric_stereo.regression import regress


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Calibrated(Record):
    """Normals and albedo of pixels.

    Attributes:
        normals: Unit, in the frame of the lights; zero where a pixel is black.
        albedo: Of each colour, not negative.
        weight: Final weight of each sample; 0 where missing or in shadow.
    """

    normals: Float[Tensor, "3 pixel"]
    albedo: Float[Tensor, "channel pixel"]
    weight: Float[Tensor, "view pixel"]


def calibrated_stereo(
    radiance: Float[Tensor, "view channel pixel"],
    weight: Float[Tensor, "view pixel"],
    lights: Float[Tensor, "view 3"],
    *,
    robust: bool = True,
) -> Calibrated:
    r"""Recover normals and albedos of pixels under known distant point lights.

    Weights are those of the mean of the colours; see :func:`.regress`. Normal and albedos are then
    the least-squares solution over all colours: with :math:`A = \sum w\, l l^\top = C C^\top`
    and ``b_c`` the solution of one colour, :math:`C^\top n` is the leading eigenvector of
    :math:`\sum_c C^\top b_c b_c^\top C`.

    Args:
        radiance: Linear. Samples without weight are ignored.
        weight: Not negative; 0 where missing.
        lights: Direction to the point light times its irradiance.

    Underdetermined, giving one of the minima, where a pixel has fewer lit samples than unknowns
    or lights in one plane; see :func:`.determined`. Constant to autograd.
    """
    with torch.no_grad():
        seen = weight > 0
        x = torch.where(seen[:, None], radiance, 0).double()
        gray = regress(x.mean(dim=1), weight, lights, robust=robust)
        rows = lights.double()
        heavy = gray.weight
        packed = outer(rows.mT) @ heavy
        factored = PackedCholesky(packed, 3)
        found = torch.stack([factored.solve(rows.mT @ (heavy * one)) for one in x.unbind(dim=1)])
        normals, albedo = _shared(unpacked(packed, 3), found)
        return Calibrated(normals=normals, albedo=albedo, weight=heavy)


def chromatic_albedo(
    radiance: Float[Tensor, "view channel pixel"],
    weight: Float[Tensor, "view pixel"],
    shade: Float[Tensor, "view pixel"],
) -> Float[Tensor, "channel pixel"]:
    """Fit the albedo of each colour, not negative, to the shading of albedo 1."""
    x = torch.where((weight > 0)[:, None], radiance, 0).to(shade)
    square = (weight * shade * shade).sum(dim=0)
    product = ((weight * shade)[:, None] * x).sum(dim=0)
    return (product / torch.where(square > 0, square, 1)).clamp_min(0)


def _shared(
    inner: Float[Tensor, "pixel 3 3"], found: Float[Tensor, "channel 3 pixel"]
) -> tuple[Float[Tensor, "3 pixel"], Float[Tensor, "channel pixel"]]:
    """Assign each pixel the least-squares normal over all colours, and the albedos under it."""
    vectors = found.permute(2, 1, 0)  # pixel, 3, channel
    scale = inner.diagonal(dim1=1, dim2=2).sum(dim=1).clamp_min(torch.finfo(inner.dtype).tiny)
    eye = torch.eye(3).to(inner)
    root = torch.linalg.cholesky_ex(inner + 1e-12 * scale[:, None, None] * eye).L
    white = root.mT @ vectors
    if white.shape[2] == 1:
        lead = white[..., 0]
    else:
        lead = torch.linalg.eigh(white @ white.mT).eigenvectors[..., -1]
    normal = torch.linalg.solve_triangular(root.mT, lead[..., None], upper=True)[..., 0]
    size = normal.norm(dim=1, keepdim=True)
    normal = normal / torch.where(size > 0, size, 1)
    weighted = (inner @ normal[..., None])[..., 0]
    square = (weighted * normal).sum(dim=1, keepdim=True)
    albedo = (weighted[..., None] * vectors).sum(dim=1) / torch.where(square > 0, square, 1)
    sign = torch.where(albedo.sum(dim=1, keepdim=True) < 0, -1.0, 1.0)
    black = (vectors == 0).all(dim=2).all(dim=1)
    normal = torch.where(black[:, None], 0, sign * normal)
    return normal.mT, (sign * albedo).clamp_min(0).mT
