"""Settings of the coarse surface, and of remeshing between passes."""

from dataclasses import dataclass
from typing import Annotated

from pimper_torch.runtime.config import Range, require_ranges


@dataclass(frozen=True, slots=True, kw_only=True)
class DensifyConfig:
    """The resolutions at which depth maps are searched.

    Attributes:
        coarsest_px: Longer side of the photographs, about, where the whole range of depths
            is searched.
        levels: How often the resolution doubles from there, that included.
        max_hypotheses: Of the search of the whole range.
    """

    coarsest_px: Annotated[int, Range(least=32, most=65_535)] = 100
    levels: Annotated[int, Range(least=1, most=16)] = 3
    max_hypotheses: Annotated[int, Range(least=8, most=10_000)] = 160

    def __post_init__(self) -> None:
        require_ranges(self)

    def factors(self, longest_px: int) -> tuple[int, ...]:
        """Return by how much photographs of that size are reduced, the coarsest first."""
        coarsest = max(1, round(longest_px / self.coarsest_px))
        return tuple(dict.fromkeys(max(1, coarsest >> rank) for rank in range(self.levels)))


@dataclass(frozen=True, slots=True, kw_only=True)
class FineSurfaceConfig:
    """Which holes of the surface are closed.

    Attributes:
        hole_px: Side of a square as large as the largest hole that is closed whatever made it,
            pixels of the finest depth maps. Strips along a border that are narrower go, where
            they are small or unsupported.
        max_unseen: Fraction of the area seen that a hole may have which only lack of views made,
            such as the bottom of a deep concavity, to be closed.
    """

    hole_px: Annotated[float, Range(least=0)] = 24.0
    max_unseen: Annotated[float, Range(least=0, below=1)] = 0.02

    def __post_init__(self) -> None:
        require_ranges(self, "fine_surface")


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
    levels: int = 3

    def __post_init__(self) -> None:
        require_ranges(self, "coarse_surface")
        DensifyConfig(levels=self.levels)


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
