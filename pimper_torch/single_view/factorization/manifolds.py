r"""Photometric manifolds of each order of lighting, and their ambiguities.

Radiance is :math:`x = l^\top s` with a light ``l`` and a shading vector ``s`` that depends
on albedo and normal alone. The set of these vectors determines the ambiguity of a factorization:

=====================  ====  =============================  =====================
light                  rank  :math:`s`                      ambiguity
=====================  ====  =============================  =====================
any low-rank matrix    any   any vector                     an invertible matrix
a distant point light  3     :math:`\rho n`: any vector     an invertible 3 x 3
first order            4     :math:`\rho (1, n)`            scaled Lorentz
=====================  ====  =============================  =====================

First order is :class:`pimper_torch.photometry.manifolds.Cone`.

Source: Basri, Jacobs & Kemelmacher, IJCV 72(3), 2007; Ramamoorthi & Hanrahan, 2001.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.photometry.cone import tangents
from pimper_torch.photometry.quadratics import outer


@dataclass(frozen=True, slots=True)
class Free:
    """Any vectors: low-rank factorization, and with rank three albedo times normal."""

    rank: int = 3
    flat: ClassVar[bool] = True

    def project(self, shading: Float[Tensor, "*batch rank"]) -> Float[Tensor, "*batch rank"]:
        """Return the nearest vector of the manifold: the vector itself."""
        return shading

    def retract(self, shading: Float[Tensor, "*batch rank"]) -> Float[Tensor, "*batch rank"]:
        """Return the end of the step: the manifold is linear."""
        return shading

    def curvature(
        self,
        shading: Float[Tensor, "*batch rank sample"],
        slope: Float[Tensor, "*batch rank sample"],
    ) -> Float[Tensor, "*batch sample rank rank"]:
        """Return the manifold's part of second derivatives: flat, it has none."""
        return slope.new_zeros(*slope.shape[:-2], slope.shape[-1], self.rank, self.rank)

    def tangents(self, shading: Float[Tensor, "*batch rank sample"]) -> list[Tensor]:
        """Span the space; with rank three by albedo, then by two rotations of the normal."""
        if self.rank == 3:
            _, normal = self.split(shading.mT)
            return [column.mT for column in (normal, *tangents(normal))]
        eye = torch.eye(self.rank, dtype=shading.dtype, device=shading.device)
        return [axis[:, None].expand_as(shading) for axis in eye]

    def split(
        self, shading: Float[Tensor, "*batch rank"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """Return albedo and unit normal of vectors of rank three."""
        self._only_three()
        length = shading.norm(dim=-1)
        return length, shading / torch.where(length > 0, length, 1)[..., None]

    def join(
        self, albedo: Float[Tensor, "*batch"], normals: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch 3"]:
        """Return the vectors of albedo and normal."""
        self._only_three()
        return albedo[..., None] * normals

    def normal_prior(
        self, normals: Float[Tensor, "*batch 3 sample"]
    ) -> Float[Tensor, "*batch 6 sample"]:
        r"""Return the penalty :math:`\lVert b - (b \cdot \bar n) \bar n \rVert^2`, packed."""
        self._only_three()
        one, zero = torch.ones_like(normals[..., 0, :]), torch.zeros_like(normals[..., 0, :])
        unit = torch.stack([one, zero, zero, one, zero, one], dim=-2)
        return unit - outer(normals)

    def _only_three(self) -> None:
        if self.rank != 3:
            raise InputError(
                f"vectors of rank {self.rank} have no albedo and normal; needed: rank 3."
            )
