r"""The variational energy that keeps the centre of facets and smooths their seams.

.. math:: E(S) = \int \lambda (1 - G) |\cup S_\mu - S|^2 + G |\nabla S|^2

over the flat facets, in linear finite elements on the subdivided mesh: lumped masses, cotangents,
and G averaged over each face. The surface S is a place for every vertex, so that the three
coordinates are three right-hand sides of one system.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.geometry.finite_elements import (
    Elements,
    cotangent_laplacian,
    elements,
    lumped_mass,
)
from pimper_torch.geometry.subdivision import Subdivision
from pimper_torch.geometry.topology import face_pairs
from pimper_torch.records import Record

# Fidelity, as a fraction of the usual, that ties what no patch supports to the flat facets: it
# makes the system definite on an island without support, and is nothing elsewhere.
_TIE = 1e-9

# A needle's area is taken as at least this fraction of its longest edge squared: its cotangents
# would otherwise spoil the condition of the whole system.
_MIN_SHAPE = 1e-4

# A facet with a smaller fraction of supported vertices is taken to lie as the coarse mesh does.
_TREND_FRACTION = 0.5


def seam_weight(barycentric: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    r"""Return G: where a facet is a seam and where it is its centre.

    :math:`G = \frac12 \sqrt{|a - b| + |a - c| + |c - b|}` of the barycentric coordinates.

    >>> corner, edge, centre = [1.0, 0, 0], [0.5, 0.5, 0], [1 / 3] * 3
    >>> seam_weight(torch.tensor([corner, edge, centre]))
    tensor([0.7071, 0.5000, 0.0000])
    """
    return (barycentric - barycentric.roll(1, dims=-1)).abs().sum(dim=-1).sqrt() / 2


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class System(Record):
    """Normal equations ``(M + L) S = M (union) + pull``.

    Attributes:
        rows: Of the entries of ``M + L``; entries named twice add up.
        cols: Likewise.
        values: The entries, float64; symmetric and positive definite.
        mass: The diagonal of ``M``.
    """

    rows: Int[Tensor, " entry"]
    cols: Int[Tensor, " entry"]
    values: Float[Tensor, " entry"]
    mass: Float[Tensor, " vertex"]


def assemble(
    subdivision: Subdivision,
    fidelity: Float[Tensor, " facet"],
    supported: Bool[Tensor, " vertex"],
) -> System:
    """Assemble the normal equations of the energy.

    Args:
        subdivision: What the energy is integrated over.
        fidelity: Lambda of each facet, 1/length^2.
        supported: Where the union is known. Elsewhere the mass is (nearly) zero, and the
            smoothness term alone fills S in.

    Constant to autograd: it holds the geometry of the flat facets only.
    """
    weights = seam_weight(subdivision.barycentric.double())
    mesh = _elements(subdivision)
    mass = lumped_mass(mesh, fidelity.double()[subdivision.face_facet])
    mass = mass * (1 - weights) * torch.where(supported, 1, _TIE)
    seams = weights[subdivision.faces].mean(dim=1)
    rows, cols, values = cotangent_laplacian(mesh, seams, _MIN_SHAPE)
    diagonal = torch.arange(mesh.count, device=mass.device)
    return System(
        rows=torch.cat([rows, diagonal]),
        cols=torch.cat([cols, diagonal]),
        values=torch.cat([values, mass]),
        mass=mass,
    )


def facet_trends(
    subdivision: Subdivision,
    blend: Float[Tensor, "vertex 3"],
    supported: Bool[Tensor, " vertex"],
    num_facets: int,
) -> tuple[Float[Tensor, "facet 3 3"], Bool[Tensor, " facet"]]:
    """Fit how the union, facet by facet, stretches and tilts the flat facet.

    Returns:
        J of the least-squares fit ``union = J (point) + constant`` over each facet's
        supported vertices, and whether it was fitted: not, and then the identity, where
        fewer than half of the vertices, or fewer than three, are supported.

    Differentiable in ``union``.
    """
    known = supported.double()
    number = _per_facet(known, subdivision, num_facets)
    total = _per_facet(torch.ones_like(known), subdivision, num_facets)
    per_one = 1 / number.clamp_min(1)[:, None]
    points = subdivision.points.detach().double()
    lift = torch.where(supported[:, None], blend.double() - points, 0)
    center = _per_facet(known[:, None] * points, subdivision, num_facets) * per_one
    mean = _per_facet(lift, subdivision, num_facets) * per_one
    away = known[:, None] * (points - center[subdivision.facet])
    change = known[:, None] * (lift - mean[subdivision.facet])
    spread = _per_facet(away[:, :, None] * away[:, None, :], subdivision, num_facets)
    common = _per_facet(change[:, :, None] * away[:, None, :], subdivision, num_facets)
    # The spread has rank two, for a facet is flat; a ridge would not leave planes exact.
    inverse = torch.linalg.pinv(spread, rtol=1e-8, hermitian=True)
    usable = (number >= _TREND_FRACTION * total) & (number >= 3)
    slope = torch.where(usable[:, None, None], common @ inverse, 0)
    return torch.eye(3, dtype=slope.dtype, device=slope.device) + slope, usable


def plane_regularization(
    subdivision: Subdivision,
    trends: Float[Tensor, "facet 3 3"],
    fitted: Bool[Tensor, " facet"],
) -> Float[Tensor, "vertex 3"]:
    r"""Return the right-hand side that keeps S from sliding along itself.

    The energy is that of a membrane: taken literally it draws an open rim inward by about
    the smoothing radius, and pulls the surface along itself wherever G changes, both on
    perfectly flat data. What it exerts on a facet's own plane (slope J, from
    :func:`facet_trends`) is therefore subtracted, :math:`b = \int G J : \nabla\varphi`,
    save for the part at inner seams, :math:`\oint G J \nu`, where planes of unlike slope
    meet: that difference is the crease to be smoothed. Data on one plane then stay exactly
    what they are, whatever G does. Between two facets whose slope could not be fitted the
    crease stays as the coarse mesh has it, for want of anything better: an island without
    support keeps its shape.

    Args:
        subdivision: What the energy is integrated over.
    """
    weights = seam_weight(subdivision.barycentric.double())
    gradients = _elements(subdivision).rotated
    slope = trends[subdivision.face_facet]
    held = weights[subdivision.faces].mean(dim=1)
    regularization = held[:, None, None] / 2 * (gradients @ slope.mT)
    total = trends.new_zeros(len(subdivision.points), 3)
    total = total.index_add(0, subdivision.faces.flatten(), regularization.flatten(0, 1))
    on_border = (subdivision.barycentric == 0).any(dim=1)[subdivision.faces].sum(dim=1) >= 2
    near = on_border.nonzero()[:, 0]  # a small fraction of all faces, and pairing is not cheap
    pairs, ends = face_pairs(subdivision.faces[near])
    faces = near[pairs]
    facets = subdivision.face_facet[faces]
    seam = (facets[:, 0] != facets[:, 1]) & fitted[facets].any(dim=1)
    faces, ends = faces[seam], ends[seam]
    corners = subdivision.faces[faces]
    opposite = (corners[..., None] != ends[:, None, None, :]).all(dim=-1)
    inward = (opposite[..., None] * gradients[faces]).sum(dim=2)
    jump = (slope[faces] @ inward[..., None])[..., 0].sum(dim=1)  # times the edge's length
    weight = weights[ends].mean(dim=1) / 2
    return total.index_add(0, ends.flatten(), (weight[:, None] * jump).repeat_interleave(2, dim=0))


def _elements(subdivision: Subdivision) -> Elements:
    return elements(subdivision.points.detach().double(), subdivision.faces)


def _per_facet(
    values: Float[Tensor, "vertex ..."], subdivision: Subdivision, num_facets: int
) -> Float[Tensor, "facet ..."]:
    return values.new_zeros(num_facets, *values.shape[1:]).index_add(0, subdivision.facet, values)
