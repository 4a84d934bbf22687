"""Settings of the coarse surface, and of remeshing between passes."""

from dataclasses import dataclass
from typing import Annotated

from pimper_torch.runtime.config import Range, require_ranges


@dataclass(frozen=True, slots=True, kw_only=True)
class CoarseSurfaceConfig:
    """The reference view and the size of the coarse mesh.

    Attributes:
        reference: Name or stem of the frontal photograph; empty chooses it.
        num_facets: About so many are left after simplification.
        levels: Resolutions of the depth maps, the longer side of the first about 100 pixels, each
            other one twice that before.
    """

    reference: str = ""
    num_facets: Annotated[int, Range(least=4, most=1_000_000)] = 3000
    levels: Annotated[int, Range(least=1, most=16)] = 3

    def __post_init__(self) -> None:
        require_ranges(self, "coarse_surface")


@dataclass(frozen=True, slots=True, kw_only=True)
class RemeshConfig:
    """Which facets are split, and which dropped.

    Attributes:
        max_departure: Distance, in samples, that nine in ten of a facet's subdivided mesh vertices
            may lie off its plane.
        max_spread_deg: Root mean square angle of the surface's normals within a facet.
        min_samples: A facet with fewer across (side of the equilateral triangle of its area) is
            never split.
        max_facets: The worst facets are split first, as long as there are no more than so many
            afterwards.
        max_hole: Facets without data stay when neighbours enclose them and they have no more
            than this fraction of the mesh's area together.
    """

    max_departure: Annotated[float, Range(above=0)] = 2.0
    max_spread_deg: Annotated[float, Range(above=0, most=180)] = 12.0
    min_samples: Annotated[float, Range(above=0, most=1e9)] = 12.0
    max_facets: Annotated[int, Range(least=1, most=1_000_000)] = 5000
    max_hole: Annotated[float, Range(least=0, below=1)] = 0.02

    def __post_init__(self) -> None:
        require_ranges(self, "remesh")
