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

from pimper_torch.geometry.finite_elements import cotangent_laplacian, elements, lumped_mass
from pimper_torch.geometry.subdivision import Subdivision
from pimper_torch.records import Record

# Fidelity, as a fraction of the usual, that ties what no patch supports to the flat facets: it
# makes the system definite on an island without support, and is nothing elsewhere.
_TIE = 1e-9

# A needle's area is taken as at least this fraction of its longest edge squared: its cotangents
# would otherwise spoil the condition of the whole system.
_MIN_SHAPE = 1e-4


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
    """Normal equations ``(M + L) S = M (union)``.

    Attributes:
        rows: Of the entries of ``M + L``; entries named twice add up.
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
    mesh = elements(subdivision.points.detach().double(), subdivision.faces)
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
