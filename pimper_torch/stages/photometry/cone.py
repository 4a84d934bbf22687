r"""Photometric manifolds: sets of possible shading vectors. For first-order light, a cone.

Radiance is :math:`x = l^\top s` with a light ``l`` and a shading vector ``s`` that depends on
albedo and normal alone. To first order it is :math:`s = \rho (1, n)`, of rank four, and the
ambiguity is a scaled Lorentz transformation: the vectors are a light cone in four dimensions, with
albedo as time axis and the normal as space axes. Other orders of light and low-rank matrices are in
:mod:`pimper_torch.single_view.factorization.low_rank`.

Source: Basri, Jacobs & Kemelmacher, IJCV 72(3), 2007; Ramamoorthi & Hanrahan, 2001.
"""

from dataclasses import dataclass
from typing import ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.lighting.light_field import harmonics
from pimper_torch.records.shapes import Scalars, Vectors


def project_to_cone(shading: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    r"""Return the nearest shading vectors that a Lambertian surface can produce.

    Images depend on albedo :math:`\rho` and unit normal :math:`n` only through
    :math:`(b_0, b) = (\rho, \rho n)`, so :math:`b_0 = \lVert b \rVert`. Factorization ignores
    this constraint. It is restored in the least-squares sense by
    :math:`\rho = \max(0, b_0 + \lVert b \rVert) / 2` and :math:`n = b / \lVert b \rVert`.

    Args:
        shading: ``(b_0, b_x, b_y, b_z)`` in the patch frame; albedo in image units, up
            to the scale that all patches share.

    Returns:
        Vectors on the cone. A vector without direction (``b = 0``), or nearest to the apex,
        becomes zero: that pixel has no normal, and the caller masks it.

    Differentiable except at ``b = 0`` and ``b_0 = -|b|``; masked vectors have zero gradient.

    Source: Basri, Jacobs & Kemelmacher, IJCV 72(3), 2007, for the constraint; the closed form
    is ours, checked in ``test_cone.py``.

    >>> project_to_cone(torch.tensor([1.0, 0.0, 0.0, -3.0]))
    tensor([ 2.,  0.,  0., -2.])
    """
    scalar, *vector = shading.unbind(dim=-1)
    length, directed = _length(vector)
    albedo = torch.where(directed, (scalar + length).clamp_min(0) / 2, 0)
    ratio = albedo / length
    return _vectors([albedo, *(torch.where(directed, axis, 0) * ratio for axis in vector)])


def split_shading(shading: Float[Tensor, "*batch 4"]) -> tuple[Scalars, Vectors]:
    """Return albedo and unit normal of vectors on the cone; zero without gradient at the apex."""
    albedo, *vector = shading.unbind(dim=-1)
    length, directed = _length(vector)
    return albedo, _vectors([torch.where(directed, axis / length, 0) for axis in vector])


def orthonormal_basis(normals: Vectors) -> tuple[Vectors, Vectors]:
    """Return two unit vectors that form a right-handed frame with each unit normal.

    Continuous except where ``n_z`` changes sign, which does not occur for viewer-facing normals.

    Source: Duff et al., Building an orthonormal basis, revisited, JCGT 6(1), 2017.
    """
    x, y, z = normals.unbind(dim=-1)
    sign = torch.where(z >= 0, 1.0, -1.0).to(normals.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    first = _vectors([1 + sign * x * x * a, sign * b, -sign * x])
    second = _vectors([b, sign + y * y * a, -y])
    return first, second


def tangent_columns(shading: Float[Tensor, "*batch 4 sample"]) -> list[Tensor]:
    r"""Return a basis of the cone's tangent space at each column :math:`\rho (1, n)`.

    Returns:
        Three arrays of columns: :math:`(1, n)`, which changes albedo, and
        :math:`(0, t_1), (0, t_2)`, which rotate the normal by :math:`1/\rho` radians per unit.
    """
    _, normal = split_shading(shading.mT)
    first, second = orthonormal_basis(normal)
    zero = torch.zeros_like(first[..., 0])
    return [
        torch.stack([zero + 1, *normal.unbind(dim=-1)], dim=-2),
        torch.stack([zero, *first.unbind(dim=-1)], dim=-2),
        torch.stack([zero, *second.unbind(dim=-1)], dim=-2),
    ]


def _length(vector: list[Tensor]) -> tuple[Scalars, Bool[Tensor, "*batch"]]:
    """Return lengths, 1 for zero vectors, and whether vectors are not zero.

    Vectors count as zero if the derivative of their direction exceeds the dtype's range: of length
    3e-10 or less in single precision.
    """
    x, y, z = vector
    square = x * x + y * y + z * z
    directed = square > torch.finfo(square.dtype).tiny ** 0.5
    # The square root has no gradient at zero.
    return torch.where(directed, square, 1).sqrt(), directed


def _vectors(components: list[Tensor]) -> Float[Tensor, "..."]:
    """Return components stacked on the last axis, each contiguous, for products with lights."""
    return torch.stack(components, dim=-2).mT if components[0].ndim else torch.stack(components)


@runtime_checkable
class Manifold(Protocol):
    """A set of possible shading vectors."""

    @property
    def flat(self) -> bool:
        """Whether it is the full space, so that normal equations give the minimum."""

    def project(self, shading: Float[Tensor, "*batch rank"]) -> Float[Tensor, "*batch rank"]:
        """Return the nearest vector of the manifold."""

    def retract(self, shading: Float[Tensor, "*batch rank"]) -> Float[Tensor, "*batch rank"]:
        """Return the vector of the manifold for the end of a small step along the tangents."""

    def tangents(self, shading: Float[Tensor, "*batch rank sample"]) -> list[Tensor]:
        """Return a basis of the tangent space at each column."""

    def curvature(
        self,
        shading: Float[Tensor, "*batch rank sample"],
        slope: Float[Tensor, "*batch rank sample"],
    ) -> Float[Tensor, "*batch sample tangent tangent"]:
        r"""Return :math:`g \cdot \partial^2 s` in tangent coordinates, with ``slope`` as ``g``.

        This is the manifold's part of the second derivatives of a function with gradient ``g``.
        """

    def split(self, shading: Float[Tensor, "*batch rank"]) -> tuple[Scalars, Vectors]:
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
        """Return the manifold's part of second derivatives; see :meth:`Manifold.curvature`."""
        albedo, normal = self.split(shading.mT)
        first, second = orthonormal_basis(normal)
        along, on_first, on_second = (
            (slope[..., 1:, :].mT * axis).sum(dim=-1) for axis in (normal, first, second)
        )
        zero = torch.zeros_like(albedo)
        rows = [[zero, on_first, on_second], [on_first, -along, zero], [on_second, zero, -along]]
        matrix = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
        return matrix / torch.where(albedo > 0, albedo, 1)[..., None, None]

    def join(self, albedo: Scalars, normals: Vectors) -> Float[Tensor, "*batch 4"]:
        """Return the shading vectors of albedo and normals."""
        return albedo[..., None] * harmonics(normals)

    def normal_prior(
        self, normals: Float[Tensor, "*batch 3 sample"]
    ) -> Float[Tensor, "*batch 10 sample"]:
        r"""Return :math:`\lVert b - \rho \bar n \rVert^2` as a quadratic form, packed."""
        n = normals
        one, zero = torch.ones_like(n[..., 0, :]), torch.zeros_like(n[..., 0, :])
        x, y, z = n.unbind(dim=-2)
        rows = [(n * n).sum(dim=-2), -x, -y, -z, one, zero, zero, one, zero, one]
        return torch.stack(rows, dim=-2)
