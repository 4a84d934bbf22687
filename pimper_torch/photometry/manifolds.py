r"""What shading vectors can be: a photometric manifold, of first-order light the cone.

A surface shows :math:`x = l^\top s` with a light ``l`` and a shading vector ``s`` that depends on
albedo and normal alone: :math:`s = \rho (1, n)` to first order, of rank four, which leaves a
scaled Lorentz transformation free. Other orders of light, and any low-rank matrix, are in
:mod:`pimper_torch.single_view.factorization.manifolds`.

Source: Basri, Jacobs & Kemelmacher, IJCV 72(3), 2007; Ramamoorthi & Hanrahan, 2001.
"""

from dataclasses import dataclass
from typing import ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.photometry.cone import (
    project_to_cone,
    split_shading,
    tangent_columns,
    tangents,
)
from pimper_torch.photometry.harmonics import harmonics


@runtime_checkable
class Manifold(Protocol):
    """What shading vectors can be."""

    @property
    def flat(self) -> bool:
        """Whether any vector will do, so that normal equations give the best at once."""

    def project(self, shading: Float[Tensor, "*batch rank"]) -> Float[Tensor, "*batch rank"]:
        """Give the nearest vector of the manifold."""

    def retract(self, shading: Float[Tensor, "*batch rank"]) -> Float[Tensor, "*batch rank"]:
        """Bring back what a small step along the tangents has left."""

    def tangents(self, shading: Float[Tensor, "*batch rank sample"]) -> list[Tensor]:
        """Span the tangent space at each column: albedo first, then two turns of the normal."""

    def curvature(
        self,
        shading: Float[Tensor, "*batch rank sample"],
        slope: Float[Tensor, "*batch rank sample"],
    ) -> Float[Tensor, "*batch sample tangent tangent"]:
        r"""Give the manifold's part of the second derivatives by the tangents' coordinates.

        Of a function with gradient ``slope``, :math:`g \cdot \partial^2 s`.
        """

    def split(
        self, shading: Float[Tensor, "*batch rank"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """Read albedo and unit normal off the vectors."""

    def join(
        self, albedo: Float[Tensor, "*batch"], normals: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch rank"]:
        """Give the vectors of albedo and normal."""

    def bend(
        self, normals: Float[Tensor, "*batch 3 sample"]
    ) -> Float[Tensor, "*batch packed sample"]:
        """Give the quadratic form of bending away from normals, packed."""


@dataclass(frozen=True, slots=True)
class Cone:
    r"""First-order lighting: :math:`\rho (1, n)`."""

    rank: ClassVar[int] = 4
    flat: ClassVar[bool] = False

    project = retract = staticmethod(project_to_cone)
    tangents = staticmethod(tangent_columns)
    split = staticmethod(split_shading)

    def curvature(
        self, shading: Float[Tensor, "*batch 4 sample"], slope: Float[Tensor, "*batch 4 sample"]
    ) -> Float[Tensor, "*batch sample 3 3"]:
        r"""Give the manifold's part of second derivatives; see :meth:`Manifold.curvature`."""
        albedo, normal = self.split(shading.mT)
        first, second = tangents(normal)
        along = [(slope[..., 1:, :].mT * part).sum(dim=-1) for part in (normal, first, second)]
        return bending(-along[0], along[1], along[2], torch.zeros_like(albedo), albedo)

    def join(
        self, albedo: Float[Tensor, "*batch"], normals: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch 4"]:
        """Give the vectors of albedo and normal."""
        return albedo[..., None] * harmonics(normals)

    def bend(self, normals: Float[Tensor, "*batch 3 sample"]) -> Float[Tensor, "*batch 10 sample"]:
        r"""Give the quadratic form :math:`\lVert b - \rho \bar n \rVert^2`, packed."""
        n = normals
        one, zero = torch.ones_like(n[..., 0, :]), torch.zeros_like(n[..., 0, :])
        x, y, z = n.unbind(dim=-2)
        rows = [(n * n).sum(dim=-2), -x, -y, -z, one, zero, zero, one, zero, one]
        return torch.stack(rows, dim=-2)


def bending(
    square: Float[Tensor, "*batch"],
    first: Float[Tensor, "*batch"],
    second: Float[Tensor, "*batch"],
    across: Float[Tensor, "*batch"],
    albedo: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch 3 3"]:
    """Put second derivatives by albedo and two turns together, over albedo.

    Args:
        square: By each turn twice.
        first: By albedo and the first turn.
        second: By albedo and the second.
        across: By both turns.
        albedo: In whose units turns are.
    """
    none = torch.zeros_like(square)
    rows = [[none, first, second], [first, square, across], [second, across, square]]
    matrix = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    return matrix / torch.where(albedo > 0, albedo, 1)[..., None, None]
