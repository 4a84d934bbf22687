"""The coarse shape of one surface, and the detail of another.

Normals of independent errors carry detail, but what remains of the common tilts of facets bends
the shape; with common errors they leave the shape to positions, but are then too weak to keep
single points from raising pimples. Both surfaces are solved for, and the first one is given the
coarse shape of the second.

Source: Nehab, Rusinkiewicz, Davis, Ramamoorthi: Efficiently combining positions and normals for
precise 3D geometry, SIGGRAPH 2005, for the idea; functions linear on facets are ours.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.geometry.subdivision import Subdivision
from pimper_torch.linalg.systems import prepare

# Weight of zero for every corner, beside 1 for every vertex of the subdivided mesh: it only keeps
# corners without a vertex from being singular.
_DAMPING = 1e-3


class CoarsePart:
    """Gives the continuous function linear on every facet that is nearest to values."""

    def __init__(self, subdivision: Subdivision, facets: Int[Tensor, "facet 3"]) -> None:
        self._subdivision, self._facets = subdivision, facets
        self._size = int(facets.max()) + 1
        fraction = subdivision.barycentric.double()
        rows, cols, entries = [], [], []
        for one in range(3):
            for other in range(3):
                rows.append(facets[:, one])
                cols.append(facets[:, other])
                product = fraction[:, one] * fraction[:, other]
                sums = product.new_zeros(len(facets)).index_add(0, subdivision.facet, product)
                entries.append(sums)
        each = torch.arange(self._size, device=facets.device)
        damping = torch.full_like(each, _DAMPING, dtype=fraction.dtype)
        self._normal = prepare(
            torch.cat([each, *rows]),
            torch.cat([each, *cols]),
            torch.cat([damping, *entries]),
            self._size,
            "the fusion's coarse shape",
        )

    def __call__(self, values: Float[Tensor, "vertex ..."]) -> Float[Tensor, "vertex ..."]:
        """Return it at the subdivided mesh's vertices, in one column or several. Differentiable."""
        columns = values.double().reshape(len(values), -1)
        side = columns.new_zeros(self._size, columns.shape[1])
        for corner in range(3):
            fraction = self._subdivision.barycentric[:, corner, None].double()
            side = side.index_add(
                0, self._facets[self._subdivision.facet, corner], fraction * columns
            )
        at = self._normal.solve(side)
        return self._subdivision.interpolate(at, self._facets).to(values).reshape(values.shape)
