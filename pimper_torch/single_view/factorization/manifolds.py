r"""Photometric manifolds of each order of lighting, and their ambiguities.

Radiance is :math:`x = l^\top s` with a light ``l`` and a shading vector ``s`` that depends
on albedo and normal alone. The set of these vectors determines the ambiguity of a factorization:

=====================  ====  =============================  =====================
light                  rank  :math:`s`                      ambiguity
=====================  ====  =============================  =====================
any low-rank matrix    any   any vector                     an invertible matrix
a distant point light  3     :math:`\rho n`: any vector     an invertible 3 x 3
first order            4     :math:`\rho (1, n)`            scaled Lorentz
second order           9     :math:`\rho (1, n, n n^\top)`  rotation, scale
=====================  ====  =============================  =====================

First order is :class:`pimper_torch.photometry.manifolds.Cone`.

Source: Basri, Jacobs & Kemelmacher, IJCV 72(3), 2007; Ramamoorthi & Hanrahan, 2001.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.photometry.cone import split_shading, tangents
from pimper_torch.photometry.manifolds import Cone, tangent_curvature
from pimper_torch.photometry.quadratics import outer

# Newton's iteration for the nearest second-order vector doubles its digits each step.
_SECULAR_STEPS = 30


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


@dataclass(frozen=True, slots=True)
class SecondOrder:
    r"""Second-order lighting: :math:`\rho\, Y(n)`, nine harmonics.

    :math:`Y(n) = (1, n, \sqrt 3 xy, \sqrt 3 xz, \sqrt 3 yz, \tfrac{\sqrt 3}{2}(x^2 - y^2),
    \tfrac12 (3 z^2 - 1))`, each degree of length one, other constants folded into the light.
    """

    rank: ClassVar[int] = 9
    flat: ClassVar[bool] = False

    def project(self, shading: Float[Tensor, "*batch 9"]) -> Float[Tensor, "*batch 9"]:
        r"""Return the nearest vector of the manifold.

        The normal maximises :math:`b \cdot n + n^\top Q n` on the sphere, with ``b`` and ``Q``
        the vector's first and second degree: the largest root of a secular equation, found by
        Newton's method. Albedo is a third of the maximum, or zero. Constant to autograd.
        """
        with torch.no_grad():
            vector, form = shading[..., 1:4].double(), _quadratic(shading[..., 4:].double())
            values, axes = torch.linalg.eigh(2 * form)
            inner = (axes.mT @ vector[..., None])[..., 0]
            # |(m - values)^-1 inner| = 1 has one root beyond the largest value; its inverse
            # is concave there, so that Newton from the left end never overshoots.
            top = values[..., -1:]
            tiny = 1e-12 * (
                values.abs().amax(dim=-1, keepdim=True) + vector.norm(dim=-1)[..., None]
            )
            root = top + inner[..., -1:].abs().maximum(tiny.clamp_min(1e-300))
            for _ in range(_SECULAR_STEPS):
                part = inner / (root - values)
                length = part.norm(dim=-1, keepdim=True).clamp_min(1e-90)
                slope = (part**2 / (root - values)).sum(dim=-1, keepdim=True) / length**3
                root = torch.maximum(root + (1 - 1 / length) / slope.clamp_min(1e-300), root)
            found = inner / (root - values)
            # Where b has no part along the largest value's axis, that part makes the length 1.
            remainder = (1 - found[..., :-1].square().sum(dim=-1, keepdim=True)).clamp_min(0).sqrt()
            last = torch.where(found[..., -1:] < 0, -remainder, remainder)
            found = torch.cat([found[..., :-1], last], dim=-1)
            normal = (axes @ found[..., None])[..., 0]
            normal = normal / normal.norm(dim=-1, keepdim=True).clamp_min(1e-300)
        return self._along(shading, normal.to(shading))

    def retract(self, shading: Float[Tensor, "*batch 9"]) -> Float[Tensor, "*batch 9"]:
        """Map the end of a small step along the tangents back, by its first-degree part."""
        vector = shading[..., 1:4]
        length = vector.norm(dim=-1, keepdim=True)
        return self._along(shading, vector / torch.where(length > 0, length, 1))

    def tangents(self, shading: Float[Tensor, "*batch 9 sample"]) -> list[Tensor]:
        r"""Span the tangent space: albedo, and two rotations of the normal by :math:`1/\rho`."""
        _, normal = self.split(shading.mT)
        first, second = tangents(normal)
        columns = [second_order(normal)]
        for rotation in (first, second):
            zero = torch.zeros_like(rotation[..., :1])
            columns.append(torch.cat([zero, rotation, _differential(normal, rotation)], dim=-1))
        return [column.mT for column in columns]

    def curvature(
        self, shading: Float[Tensor, "*batch 9 sample"], slope: Float[Tensor, "*batch 9 sample"]
    ) -> Float[Tensor, "*batch sample 3 3"]:
        r"""Return the manifold's part of the second derivatives; see :meth:`Cone.curvature`."""
        albedo, normal = self.split(shading.mT)
        g = slope.mT
        rotations = tangents(normal)
        outward = (g[..., 1:4] * normal).sum(dim=-1)
        outward = outward + (g[..., 4:] * _differential(normal, normal)).sum(dim=-1)
        mixed = [
            (g[..., 1:4] * rotation).sum(dim=-1)
            + (g[..., 4:] * _differential(normal, rotation)).sum(dim=-1)
            for rotation in rotations
        ]
        twice = {
            (a, b): (g[..., 4:] * _differential(rotations[a], rotations[b])).sum(dim=-1)
            for a, b in ((0, 0), (0, 1), (1, 1))
        }
        flat = tangent_curvature(-outward, mixed[0], mixed[1], twice[0, 1], albedo)
        safe = torch.where(albedo > 0, albedo, 1)
        square = torch.zeros_like(flat)
        square[..., 1, 1], square[..., 2, 2] = twice[0, 0] / safe, twice[1, 1] / safe
        return flat + square

    def split(
        self, shading: Float[Tensor, "*batch 9"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """Return albedo and unit normal of the vectors."""
        return split_shading(shading[..., :4])

    def join(
        self, albedo: Float[Tensor, "*batch"], normals: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch 9"]:
        """Return the vectors of albedo and normal."""
        return albedo[..., None] * second_order(normals)

    def normal_prior(
        self, normals: Float[Tensor, "*batch 3 sample"]
    ) -> Float[Tensor, "*batch 45 sample"]:
        r"""Return penalty :math:`\lVert b - \rho \bar n \rVert^2` as a quadratic form, packed."""
        small = Cone().normal_prior(normals)
        wide = small.new_zeros(*small.shape[:-2], 45, small.shape[-1])
        # Row i of the packed triangle of nine begins after 9 + 8 + ...; of four, 4 + 3 + ...
        nine, four = (0, 9, 17, 24), (0, 4, 7, 9)
        for row in range(4):
            wide[..., nine[row] : nine[row] + 4 - row, :] = small[
                ..., four[row] : four[row] + 4 - row, :
            ]
        return wide

    def _along(
        self, shading: Float[Tensor, "*batch 9"], normal: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch 9"]:
        basis = second_order(normal)
        albedo = (shading * basis).sum(dim=-1, keepdim=True) / 3
        return albedo.clamp_min(0) * basis


def second_order(normals: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 9"]:
    """Return the nine harmonics up to the second order; see :class:`SecondOrder`.

    >>> second_order(torch.tensor([0.0, 0.0, -1.0]))
    tensor([ 1.,  0.,  0., -1.,  0., -0., -0.,  0.,  1.])
    """
    x, y, z = normals.unbind(dim=-1)
    root = math.sqrt(3)
    square = (3 * z * z - (x * x + y * y + z * z)) / 2
    degree = [root * x * y, root * x * z, root * y * z, root / 2 * (x * x - y * y), square]
    return torch.cat(
        [torch.ones_like(normals[..., :1]), normals, torch.stack(degree, dim=-1)], dim=-1
    )


def _quadratic(degree: Float[Tensor, "*batch 5"]) -> Float[Tensor, "*batch 3 3"]:
    """Return ``Q`` with ``n^T Q n`` the sum of the second degree's harmonics, unit n."""
    xy, xz, yz, difference, square = degree.unbind(dim=-1)
    half, root = math.sqrt(3) / 2, math.sqrt(3) / 2
    rows = [
        [root * difference - square / 2, half * xy, half * xz],
        [half * xy, -root * difference - square / 2, half * yz],
        [half * xz, half * yz, square],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def _differential(
    normals: Float[Tensor, "*batch 3"], rotation: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 5"]:
    """Return the derivative of the second degree when normals move along ``rotation``."""
    x, y, z = normals.unbind(dim=-1)
    a, b, c = rotation.unbind(dim=-1)
    root = math.sqrt(3)
    degree = [
        root * (a * y + x * b),
        root * (a * z + x * c),
        root * (b * z + y * c),
        root * (x * a - y * b),
        2 * z * c - x * a - y * b,
    ]
    return torch.stack(degree, dim=-1)
