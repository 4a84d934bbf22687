"""Settings of the mesh that is made of a surface."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pimper_torch.runtime.config import Range, require_ranges


@dataclass(frozen=True, slots=True, kw_only=True)
class RepairConfig:
    """Which faces are defective, and how far a component of them may extend to be repaired.

    Attributes:
        max_extent: Diagonal of a repaired component's bounding box, as a fraction of the
            surface's; 0 repairs nothing.
        max_stretch: Longest edge of a face, in multiples of the surface's median edge; longer
            ones are spikes.
    """

    max_extent: Annotated[float, Range(least=0)] = 0.1
    max_stretch: Annotated[float, Range(above=1)] = 10.0

    def __post_init__(self) -> None:
        require_ranges(self, "repair")


@dataclass(frozen=True, slots=True, kw_only=True)
class ExtractConfig:
    """Criteria for the parts of the surface to keep.

    Attributes:
        max_expected_error: Faces with a vertex that is expected to be further off are cut out;
            a fraction of the surface's extent (diagonal of its bounding box). Infinite keeps all.
        max_hole: Connected vertices without support stay, as a filled hole, when they
            extend over no more than this fraction of the surface's extent (both diagonals
            of bounding boxes).
        max_stretch: Longest edge of a face, in multiples of the surface's median edge;
            longer ones are spikes or cliffs. Infinite keeps all.
        overturned: Which of the faces turned more than 90 degrees from the mean of their facet
            are left out: those that a fold bounds, as the others are on facets that bend far;
            all; or none.
        min_piece: Fraction of the largest connected component's area that another one needs to
            be kept; 1 keeps the largest only.
    """

    max_expected_error: Annotated[float, Range(above=0)] = 0.02
    max_hole: Annotated[float, Range(least=0)] = 1.0
    max_stretch: Annotated[float, Range(above=1)] = 10.0
    overturned: Literal["folded", "all", "none"] = "folded"
    min_piece: Annotated[float, Range(least=0, most=1)] = 0.01

    def __post_init__(self) -> None:
        require_ranges(self)
