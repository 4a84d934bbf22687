"""Errors that the terms of a facet share, since its light is fitted per facet.

Normals determine fine detail, and positions the coarse shape. Their mean difference on every facet,
blended between facets, is subtracted from the normals. Swept heights depend on the same light:
their common error is not subtracted, but its variance is estimated. Detail is solved for with
independent errors, the coarse shape with common errors, and the two are combined.

Source: Nehab, Rusinkiewicz, Davis, Ramamoorthi: Efficiently combining positions and normals for
precise 3D geometry, SIGGRAPH 2005, for the idea; facets, and functions linear on them,
instead of a smoothing kernel are ours.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.geometry.subdivision import Subdivision
from pimper_torch.linalg.sums import sum_at
from pimper_torch.linalg.systems import prepare_system
from pimper_torch.records import Record
from pimper_torch.records.shapes import PerVertex, Scalar, VertexMask, Vertices
from pimper_torch.stages.fusion.equations import Equations, SharedError

# Median of the squared length of a vector of two components of unit Gaussian noise.
MEDIAN_OF_TILT = 2 * math.log(2)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class NormalBias(Record):
    """The mean difference between the surface's normals and photometric ones, per facet.

    Attributes:
        tilt: Correction to add to the normals; world.
        count: Number of vertices with known normals.
    """

    tilt: Float[Tensor, "facet 3"]
    count: Float[Tensor, " facet"]
    known: Bool[Tensor, " facet"]

    def variance(self) -> Scalar:
        """Return a robust variance of the tilts of uncorrected normals, squared radians."""
        return self.tilt[self.known].square().sum(dim=-1).median() / MEDIAN_OF_TILT

    def at(self, subdivision: Subdivision, facets: Int[Tensor, "facet 3"]) -> Vertices:
        """Return the tilt at every vertex, blended to be continuous across facets."""
        size = int(facets.max()) + 1
        corner = facets.flatten()
        weight = self.count.repeat_interleave(3)
        total = sum_at(corner, weight, size).clamp_min(1e-12)
        tilts = (self.count[:, None] * self.tilt).repeat_interleave(3, dim=0)
        summed = sum_at(corner, tilts, size)
        return subdivision.interpolate(summed / total[:, None], facets)


def normal_bias(
    subdivision: Subdivision,
    facets: Int[Tensor, "facet 3"],
    normals: Vertices,
    shape: Vertices,
    known: VertexMask,
    most: float = 0.25,
) -> NormalBias:
    """Return the mean difference between normals and those of a shape, per facet.

    Args:
        normals: Photometric, unit.
        shape: Normals of the surface, unit.
        known: Vertices with photometric normals.
        most: Radians to which larger differences, such as across a cliff, are clipped.

    Differentiable.
    """
    difference = torch.where(known[:, None], shape - normals, 0)
    size = difference.norm(dim=-1, keepdim=True)
    difference = difference * (most / size.clamp_min(most))
    count = sum_at(subdivision.facet, known.to(difference), len(facets))
    summed = sum_at(subdivision.facet, difference, len(facets))
    return NormalBias(tilt=summed / count.clamp_min(1)[:, None], count=count, known=count > 0)


def common_variance(
    swept: Equations,
    heights: PerVertex,
    facet: Int[Tensor, " vertex"],
    otherwise: Int[Tensor, " term"],
) -> Scalar:
    """Return the variance of the error that the swept heights of a facet share.

    Args:
        swept: Equations of swept heights, each with one unknown.
        heights: Heights of the surface, to which swept heights should have contributed little.
        otherwise: Facets where other terms determine the surface; only these are evaluated.

    Differentiable.
    """
    vertex = swept.unknowns[:, 0]
    size = int(facet.max()) + 1
    residual = swept.residual(heights)
    weight = swept.information.to(residual)
    total = sum_at(facet[vertex], weight, size)
    mean = sum_at(facet[vertex], weight * residual, size)
    used = torch.zeros_like(total, dtype=torch.bool).index_fill(0, otherwise, True) & (total > 0)
    square = (mean[used] / total[used]).square()
    # 0.4549 is the median of the square of unit Gaussian noise.
    return square.median() / 0.4549 if len(square) > 0 else residual.new_zeros(())


def shared_error(variance: Scalar, facet: Int[Tensor, " vertex"], known: VertexMask) -> SharedError:
    """Return the error that the known vertices of each facet share."""
    count = torch.bincount(facet[known], minlength=int(facet.max()) + 1)
    return SharedError(variance=variance, count=count[facet].to(variance))


class PiecewiseLinearFit:
    """Least-squares fit of a continuous function that is linear on every facet."""

    def __init__(self, subdivision: Subdivision, facets: Int[Tensor, "facet 3"]) -> None:
        self._subdivision, self._facets = subdivision, facets
        self._size = int(facets.max()) + 1
        fraction = subdivision.barycentric.double()
        products = fraction[:, :, None] * fraction[:, None]
        blocks = sum_at(subdivision.facet, products, len(facets))
        rows, cols = facets.mT[:, None].expand(-1, 3, -1), facets.mT.expand(3, -1, -1)
        diagonal = torch.arange(self._size, device=facets.device)
        # Only for corners without vertices, where the matrix would be singular.
        damping = torch.full_like(diagonal, 1e-3, dtype=fraction.dtype)
        self._normal = prepare_system(
            torch.cat([diagonal, rows.flatten()]),
            torch.cat([diagonal, cols.flatten()]),
            torch.cat([damping, blocks.permute(1, 2, 0).flatten()]),
            self._size,
            "the fusion's coarse shape",
        )

    def __call__(self, values: Float[Tensor, "vertex ..."]) -> Float[Tensor, "vertex ..."]:
        """Return the fit to values at all vertices, in one or more columns. Differentiable."""
        columns = values.double().reshape(len(values), -1)
        side = columns.new_zeros(self._size, columns.shape[1])
        for corner in range(3):
            fraction = self._subdivision.barycentric[:, corner, None].double()
            side = side.index_add(
                0, self._facets[self._subdivision.facet, corner], fraction * columns
            )
        corners = self._normal.solve(side)
        return self._subdivision.interpolate(corners, self._facets).to(values).reshape(values.shape)
