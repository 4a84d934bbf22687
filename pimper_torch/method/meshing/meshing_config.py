"""Settings of the mesh that is made of a surface."""

from dataclasses import dataclass
from typing import Annotated

from pimper_torch.runtime.config import Range, require_ranges


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
        min_piece: Fraction of the largest connected component's area that another one needs to
            be kept; 1 keeps the largest only.
    """

    max_expected_error: Annotated[float, Range(above=0)] = 0.02
    max_hole: Annotated[float, Range(least=0)] = 1.0
    max_stretch: Annotated[float, Range(above=1)] = 10.0
    min_piece: Annotated[float, Range(least=0, most=1)] = 0.01

    def __post_init__(self) -> None:
        require_ranges(self)
