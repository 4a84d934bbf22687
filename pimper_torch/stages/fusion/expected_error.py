r"""The expected error of every vertex of the fused surface.

For given weights and factors the fused heights are linear in the targets of all terms. Noise of the
estimated variance is drawn for every target, and the same systems are solved for it: the root mean
square of the solutions is the standard error of the heights, over all wavelengths and with all
correlations. Common errors, such as those of the light, are drawn jointly for adjacent facets.
Residuals do not contain all errors: a surface that follows smooth errors of its normals has none,
so the variance of a kind is at least the stated one. Slopes that were kept or continued instead of
measured have a larger error than measured ones, by a factor estimated on rendered scenes.

It is conditional on the cameras, and excludes errors that all terms share.

Source: Papandreou & Yuille, Gaussian sampling by local perturbations, NIPS 2010, for samples of a
Gaussian by perturbed least squares. Noise with other variances than the weights imply is ours.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.subdivision import Subdivision
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.linalg.sums import sum_at
from pimper_torch.linalg.systems import solve_compressed
from pimper_torch.records.shapes import PerVertex, Scalar
from pimper_torch.stages.fusion.equations import Equations
from pimper_torch.stages.fusion.estimate import FusedHeights
from pimper_torch.stages.fusion.normal_bias import PiecewiseLinearFit
from pimper_torch.stages.fusion.terms import UNMEASURED

# Side of the regions of a common error, in edges of a median facet. Errors of the fused surface of
# rendered mug, potatoes and jar (16 photographs of 640x480) are correlated by 0.5 to 0.8 over 1.5
# to 3 % of the diagonal and by 0.3 to 0.5 over 3 to 6 %; their facets are 2 to 3 %.
_REGION = 2.5


@torch.no_grad()
def expected_error(
    fine: FusedHeights,
    coarse: FusedHeights,
    subdivision: Subdivision,
    facets: Int[Tensor, "facet 3"],
    draws: int,
) -> PerVertex:
    """Return the standard error of every height of the fused surface.

    Args:
        fine: The solution for the detail.
        coarse: The solution for the coarse shape, with errors that neighbours share; the same
            record if there was only one solve. Noise has the factors of ``fine``.
        draws: Number of noise samples ``n``; the relative error of the result is ``1 / sqrt(2 n)``.

    Returns:
        Errors along the directions of the heights, scene units, float64. Not differentiable.

    Raises:
        SingularSystemError: See :func:`~pimper_torch.linalg.systems.solve_compressed`.
    """
    generator = torch.Generator().manual_seed(0)  # of noise; any seed
    region = regions(subdivision)
    solves = (coarse,) if fine is coarse else (coarse, fine)
    sides = []
    for _ in range(draws):
        noise = [
            _noise(kind, weight, factor, subdivision, region, generator)
            for kind, weight, factor in zip(coarse.kinds, coarse.weights, fine.factors, strict=True)
        ]
        start = _normal(generator, coarse.damping) / coarse.damping.double().sqrt()
        systems = [solve.system(noise, start) for solve in solves]
        sides.append([side for _, side in systems])
    solutions = []
    for (matrix, _), drawn in zip(systems, zip(*sides, strict=True), strict=True):
        columns, what = torch.stack(drawn, dim=1), "the expected error"
        found = solve_compressed(matrix, columns, what=what, tolerance=1e-2)
        solutions.append(found.to(coarse.damping.device))
    error = solutions[0]
    for detail in solutions[1:]:
        error = detail + PiecewiseLinearFit(subdivision, facets)(error - detail)
    return error.square().mean(dim=1).sqrt()


def regions(subdivision: Subdivision) -> Int[Tensor, " facet"]:
    """Return a label per facet: the cell of a grid, a few facets wide, that contains its centre."""
    # A facet without inner vertices may have no vertex assigned, but has faces.
    num_facets = int(subdivision.face_facet.max()) + 1
    count = torch.bincount(subdivision.facet, minlength=num_facets).clamp_min(1)[:, None]
    points = subdivision.points.double()
    centre = sum_at(subdivision.facet, points, num_facets) / count
    areas = face_normals(points, subdivision.faces).norm(dim=1) / 2
    area = sum_at(subdivision.face_facet, areas, num_facets)
    edge = (4 / math.sqrt(3) * area[area > 0].median()).sqrt()  # of an equilateral facet
    _, label = torch.unique((centre / (_REGION * edge)).floor(), dim=0, return_inverse=True)
    return label


def _noise(
    kind: Equations,
    weight: Float[Tensor, " equation"],
    factor: Scalar,
    subdivision: Subdivision,
    region: Int[Tensor, " facet"],
    generator: torch.Generator,
) -> Float[Tensor, " equation"]:
    """Return errors of targets, partly independent and partly common to a region.

    The common fraction of the variance is such that the sum over a facet has the variance implied
    by the information of its equations. Edges of a region share a tilt, so their common error
    depends on their direction.
    """
    stated = 1 / (weight * kind.information.double() * kind.correlated.double())
    variance = stated * (factor.clamp_min(1) if kind.evaluated else UNMEASURED**2)
    facet = subdivision.facet[kind.unknowns[:, 0]]
    count = torch.bincount(facet, minlength=1)[facet].to(variance)
    common = torch.ones_like(variance)
    if kind.evaluated:
        common = ((kind.correlated.double() - 1) / (count - 1).clamp_min(1)).clamp(0, 1)
    num_regions = int(region.max()) + 1
    if kind.is_slope:
        start, end = kind.unknowns.unbind(dim=1)
        along = normalize((subdivision.points[end] - subdivision.points[start]).double(), dim=-1)
        tilt = _normal(generator, variance.new_empty(num_regions, 3))
        shared = (tilt[region[facet]] * along).sum(dim=-1)
    else:
        shared = _normal(generator, variance.new_empty(num_regions))[region[facet]]
    single = _normal(generator, variance)
    return variance.sqrt() * ((1 - common).sqrt() * single + common.sqrt() * shared)


def _normal(generator: torch.Generator, like: Tensor) -> Tensor:
    return torch.randn(like.shape, generator=generator, dtype=torch.float64).to(like.device)
