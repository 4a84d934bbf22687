"""What normals of a whole facet are off by: light is fitted facet by facet, and errs so.

Normals know the fine detail, and positions the coarse shape. The mean difference of the two on
every facet, blended between facets, is taken out of the normals.

Source: Nehab, Rusinkiewicz, Davis, Ramamoorthi: Efficiently combining positions and normals for
precise 3D geometry, SIGGRAPH 2005, for the idea; facets in place of a smoothing kernel are ours.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.geometry.lattice import Lattice
from pimper_torch.records import Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Drift(Record):
    """The mean difference of normals on every facet.

    Attributes:
        tilt: To be added to the normals; world.
        count: Vertices with normals.
        known: Where there are any.
    """

    tilt: Float[Tensor, "facet 3"]
    count: Float[Tensor, " facet"]
    known: Bool[Tensor, " facet"]

    def at(self, lattice: Lattice, facets: Int[Tensor, "facet 3"]) -> Float[Tensor, "vertex 3"]:
        """Blend the tilts over the lattice, continuous across facets."""
        size = int(facets.max()) + 1
        corner = facets.flatten()
        weight = self.count.repeat_interleave(3)
        total = weight.new_zeros(size).index_add(0, corner, weight).clamp_min(1e-12)
        summed = self.tilt.new_zeros(size, 3).index_add(
            0, corner, (self.count[:, None] * self.tilt).repeat_interleave(3, dim=0)
        )
        return lattice.interpolate(summed / total[:, None], facets)


def drift(
    lattice: Lattice,
    facets: Int[Tensor, "facet 3"],
    normals: Float[Tensor, "vertex 3"],
    shape: Float[Tensor, "vertex 3"],
    known: Bool[Tensor, " vertex"],
) -> Drift:
    """Compare normals with those of a shape, facet by facet.

    Args:
        lattice: The facets, subdivided.
        facets: The coarse mesh's faces.
        normals: Photometric, unit.
        shape: Of the surface, unit.
        known: Where there are photometric ones.

    Large differences, as across a cliff, are cut to a quarter of a radian.
    """
    apart = torch.where(known[:, None], shape - normals, 0).detach()
    size = apart.norm(dim=-1, keepdim=True)
    apart = apart * (0.25 / size.clamp_min(0.25))
    held = known.to(apart)
    count = held.new_zeros(len(facets)).index_add(0, lattice.facet, held)
    summed = apart.new_zeros(len(facets), 3).index_add(0, lattice.facet, apart)
    return Drift(tilt=summed / count.clamp_min(1)[:, None], count=count, known=count > 0)
