r"""The expected error of every vertex of the fused surface.

The fused heights are linear in the targets of all terms once weights and factors are found.
So noise is drawn for every target, of the variance that its residuals showed, and answered by the
same solves: the root mean square of the answers is the standard error of the heights, over all
wavelengths and with all correlations. Common errors, such as those of the light, are drawn
together for a few adjacent facets. Residuals do not show all errors: a surface that follows smooth
errors of its normals leaves none, so that no kind has less variance than it claims; and slopes
that were not measured, but kept or continued, have a larger error than measured ones, by a factor
found on rendered scenes.

It is conditional on the cameras, and does not include errors that all terms share.

Source: Papandreou & Yuille, Gaussian sampling by local perturbations, NIPS 2010, for samples of a
Gaussian by perturbed least squares. Noise that differs from what the weights say is ours.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.ground.geometry.subdivision import Subdivision
from pimper_torch.ground.geometry.surfaces import face_normals
from pimper_torch.ground.linalg.sums import sum_at
from pimper_torch.ground.linalg.systems import prepare
from pimper_torch.ground.shapes import PerVertex, Scalar
from pimper_torch.method.fusion.equations import Equations
from pimper_torch.method.fusion.estimate import Fused
from pimper_torch.method.fusion.normal_bias import CoarsePart
from pimper_torch.method.fusion.terms import UNMEASURED

# Side of the regions of a common error, in edges of a facet of usual size. Errors of the fused
# surface of rendered mug, potatoes and jar (16 photographs of 640x480) are correlated by 0.5 to
# 0.8 over 1.5 to 3 % of the diagonal and by 0.3 to 0.5 over 3 to 6 %; their facets are 2 to 3 %.
_REGION = 2.5


@torch.no_grad()
def expected_error(
    fine: Fused, coarse: Fused, subdivision: Subdivision, facets: Int[Tensor, "facet 3"], draws: int
) -> PerVertex:
    """Return the standard error of every height of the fused surface.

    Args:
        fine: The solve that detail is from.
        coarse: The solve that the coarse shape is from, with what neighbours err by together;
            the same record where there was only one solve. Noise has the factors of ``fine``.
        draws: Of noise. The result is off by one over the square root of twice as many.

    Returns:
        Along the directions of the heights, scene units, float64. A constant to autograd.

    Raises:
        SingularSystemError: See :func:`~pimper_torch.ground.linalg.systems.prepare`.
    """
    generator = torch.Generator().manual_seed(0)  # of noise: any will do
    region = regions(subdivision)
    solves = (coarse,) if fine is coarse else (coarse, fine)
    sides: list[list[Tensor]] = [[] for _ in solves]
    for _ in range(draws):
        noise = [
            _noise(kind, weight, factor, subdivision, region, generator)
            for kind, weight, factor in zip(coarse.kinds, coarse.weights, fine.factors, strict=True)
        ]
        start = _normal(generator, coarse.damping) / coarse.damping.double().sqrt()
        for solve, side in zip(solves, sides, strict=True):
            side.append(_answerable(solve, noise, start))
    answers = []
    for solve, side in zip(solves, sides, strict=True):
        size, what = len(solve.heights), "the expected error"
        system = prepare(*solve.matrix(), size, what, tolerance=1e-2)
        answers.append(system.solve(torch.stack(side, dim=1)))
        del system
    off = answers[0]
    for detail in answers[1:]:
        off = detail + CoarsePart(subdivision, facets)(off - detail)
    return off.square().mean(dim=1).sqrt()


def regions(subdivision: Subdivision) -> Int[Tensor, " facet"]:
    """Group the facets whose centres lie in one cell of a grid, a few facets wide."""
    # A facet whose vertices all lie on its edges may be named by its faces alone.
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
    """Draw errors of targets: of each by itself, and of all in a region together.

    The fraction of the variance that is drawn together makes a facet's sum vary as the information
    of its equations says. Edges of a region share a tilt, so that what they err by together
    depends on where they point.
    """
    claimed = 1 / (weight * kind.information.double() * kind.correlated.double())
    each = claimed * (factor.clamp_min(1) if kind.evaluated else UNMEASURED**2)
    facet = subdivision.facet[kind.unknowns[:, 0]]
    count = torch.bincount(facet, minlength=1)[facet].to(each)
    together = torch.ones_like(each)
    if kind.evaluated:
        together = ((kind.correlated.double() - 1) / (count - 1).clamp_min(1)).clamp(0, 1)
    num_regions = int(region.max()) + 1
    if kind.unknowns.shape[1] == 2:
        one, other = kind.unknowns.unbind(dim=1)
        along = normalize((subdivision.points[other] - subdivision.points[one]).double(), dim=-1)
        tilt = _normal(generator, each.new_empty(num_regions, 3))
        shared = (tilt[region[facet]] * along).sum(dim=-1)
    else:
        shared = _normal(generator, each.new_empty(num_regions))[region[facet]]
    own = _normal(generator, each)
    return each.sqrt() * ((1 - together).sqrt() * own + together.sqrt() * shared)


def _answerable(fused: Fused, noise: list[Float[Tensor, " _"]], starts: PerVertex) -> PerVertex:
    """Return the right-hand side that errors of the targets make."""
    rhs = fused.damping.double() * starts
    for kind, weight, factor, off in zip(
        fused.kinds, fused.weights, fused.factors, noise, strict=True
    ):
        scaled = (weight * kind.information.double() / factor * off)[:, None]
        weighted = (scaled * kind.coefficients.double()).flatten()
        rhs = rhs.index_add(0, kind.unknowns.flatten(), weighted)
    return rhs


def _normal(generator: torch.Generator, like: Tensor) -> Tensor:
    return torch.randn(like.shape, generator=generator, dtype=torch.float64).to(like.device)
