r"""Photometric manifolds: the sets of possible shading vectors. First-order light has a cone.

Radiance is :math:`x = l^\top s` with a light ``l`` and a shading vector ``s`` that depends on
albedo and normal alone: :math:`s = \rho (1, n)` to first order, of rank four, whose ambiguity is
a scaled Lorentz transformation. Other orders of light, and low-rank matrices, are in
:mod:`pimper_torch.single_view.factorization.low_rank`.

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
    """A set of possible shading vectors."""

    @property
    def flat(self) -> bool:
        """Whether it is the whole space, so that normal equations give the minimum."""

    def project(self, shading: Float[Tensor, "*batch rank"]) -> Float[Tensor, "*batch rank"]:
        """Return the nearest vector of the manifold."""

    def retract(self, shading: Float[Tensor, "*batch rank"]) -> Float[Tensor, "*batch rank"]:
        """Map the end of a small step along the tangents back to the manifold."""

    def tangents(self, shading: Float[Tensor, "*batch rank sample"]) -> list[Tensor]:
        """Span the tangent space at each column."""

    def curvature(
        self,
        shading: Float[Tensor, "*batch rank sample"],
        slope: Float[Tensor, "*batch rank sample"],
    ) -> Float[Tensor, "*batch sample tangent tangent"]:
        r"""Return :math:`g \cdot \partial^2 s` by the tangents' coordinates, ``slope`` being ``g``.

        It is the manifold's part of the second derivatives of a function with gradient ``g``.
        """

    def split(
        self, shading: Float[Tensor, "*batch rank"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """Return albedo and unit normal of the vectors."""


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
        r"""Return the manifold's part of second derivatives; see :meth:`Manifold.curvature`."""
        albedo, normal = self.split(shading.mT)
        first, second = tangents(normal)
        along = [(slope[..., 1:, :].mT * part).sum(dim=-1) for part in (normal, first, second)]
        return tangent_curvature(-along[0], along[1], along[2], torch.zeros_like(albedo), albedo)

    def join(
        self, albedo: Float[Tensor, "*batch"], normals: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch 4"]:
        """Return the vectors of albedo and normal."""
        return albedo[..., None] * harmonics(normals)

    def normal_prior(
        self, normals: Float[Tensor, "*batch 3 sample"]
    ) -> Float[Tensor, "*batch 10 sample"]:
        r"""Return penalty :math:`\lVert b - \rho \bar n \rVert^2` as a quadratic form, packed."""
        n = normals
        one, zero = torch.ones_like(n[..., 0, :]), torch.zeros_like(n[..., 0, :])
        x, y, z = n.unbind(dim=-2)
        rows = [(n * n).sum(dim=-2), -x, -y, -z, one, zero, zero, one, zero, one]
        return torch.stack(rows, dim=-2)


def tangent_curvature(
    square: Float[Tensor, "*batch"],
    first: Float[Tensor, "*batch"],
    second: Float[Tensor, "*batch"],
    across: Float[Tensor, "*batch"],
    albedo: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch 3 3"]:
    """Assemble second derivatives by albedo and two rotations of the normal, over albedo.

    Args:
        first: By albedo and the first rotation.
        second: By albedo and the second.
        albedo: The unit of the rotations.
    """
    none = torch.zeros_like(square)
    rows = [[none, first, second], [first, square, across], [second, across, square]]
    matrix = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    return matrix / torch.where(albedo > 0, albedo, 1)[..., None, None]
