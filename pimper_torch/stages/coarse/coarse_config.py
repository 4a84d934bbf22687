"""Settings of the coarse surface and of remeshing between passes."""

from dataclasses import dataclass
from typing import Annotated

from pimper_torch.runtime.config import Range, require_ranges


@dataclass(frozen=True, slots=True, kw_only=True)
class CoarseSurfaceConfig:
    """The reference view and the size of the coarse mesh.

    Attributes:
        reference: Name or stem of the frontal photograph; empty selects it automatically.
        num_facets: Approximate number of facets after simplification.
        levels: Number of resolutions of the depth maps. The longer side of the first has about 100
            pixels, and each next one twice as many.
    """

    reference: str = ""
    num_facets: Annotated[int, Range(least=4, most=1_000_000)] = 3000
    levels: Annotated[int, Range(least=1, most=16)] = 3

    def __post_init__(self) -> None:
        require_ranges(self, "coarse_surface")


@dataclass(frozen=True, slots=True, kw_only=True)
class RemeshConfig:
    """Criteria for splitting and dropping facets.

    Attributes:
        max_departure: Largest 90th percentile of the distances, in samples, between a facet's plane
            and its subdivided mesh vertices. Facets above it are split.
        max_spread_deg: Largest root mean square angle of the surface's normals within a facet.
        min_samples: Facets with fewer samples across (side of the equilateral triangle of equal
            area) are never split.
        max_facets: The worst facets are split first, up to this number of facets in total.
        max_hole: Facets without data stay if neighbours enclose them and a connected group has at
            most this fraction of the mesh's area.
    """

    max_departure: Annotated[float, Range(above=0)] = 2.0
    max_spread_deg: Annotated[float, Range(above=0, most=180)] = 12.0
    min_samples: Annotated[float, Range(above=0, most=1e9)] = 12.0
    max_facets: Annotated[int, Range(least=1, most=1_000_000)] = 5000
    max_hole: Annotated[float, Range(least=0, below=1)] = 0.02

    def __post_init__(self) -> None:
        require_ranges(self, "remesh")
