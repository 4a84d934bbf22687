"""The coarse shape of one surface, and the detail of another.

Normals that are trusted singly carry detail, but what is left of the tilts of whole facets bends
the shape; ones that are known to err alike leave the shape to positions, but are then too weak
to keep single points from raising pimples. Both surfaces are made, and the first one is given
the coarse shape of the second.

Source: Nehab, Rusinkiewicz, Davis, Ramamoorthi: Efficiently combining positions and normals for
precise 3D geometry, SIGGRAPH 2005, for the idea; functions linear on facets are ours.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.geometry.lattice import Lattice
from pimper_torch.linalg.equations import normal_equations
from pimper_torch.linalg.systems import solutions

# Weight that a corner is held to zero by, beside 1 for every vertex of the lattice: it decides
# nothing.
_HOLD = 1e-3


def coarse_part(
    values: Float[Tensor, " vertex"], lattice: Lattice, facets: Int[Tensor, "facet 3"]
) -> Float[Tensor, " vertex"]:
    """Give the continuous function linear on every facet that is nearest to values.

    Args:
        values: At the lattice's vertices.
        lattice: The facets, subdivided.
        facets: The coarse mesh's faces.

    Differentiable.
    """
    size = int(facets.max()) + 1
    corner, share = facets[lattice.facet], lattice.barycentric.double()
    row, col, entry, right = normal_equations(
        corner, share, values.double(), torch.ones_like(values, dtype=torch.float64), size
    )
    each = torch.arange(size, device=values.device)
    (at,) = solutions(
        torch.cat([each, row]),
        torch.cat([each, col]),
        torch.cat([torch.full_like(each, _HOLD, dtype=entry.dtype), entry]),
        right,
        what="the fusion's coarse shape",
    )
    return lattice.interpolate(at[:, None], facets)[:, 0].to(values)
