"""Settings of the extraction of a mesh."""

from dataclasses import dataclass
from typing import Annotated

from pimper_torch.runtime.config import Range, require_ranges


@dataclass(frozen=True, slots=True, kw_only=True)
class ExtractConfig:
    """Criteria for the parts of the surface to keep.

    Attributes:
        max_expected_error: Largest expected error of a face's vertices, as a fraction of the
            surface's extent (diagonal of its bounding box). Infinite keeps all faces.
        max_hole: Largest extent of connected vertices without support that stay as a filled
            hole, as a fraction of the surface's (both diagonals of bounding boxes).
        max_stretch: Longest edge of a face, in multiples of the surface's median edge; faces
            with a longer one are spikes or cliffs. Infinite keeps all faces.
        min_piece: Least area of a connected component that is kept, as a fraction of the largest
            one's; 1 keeps only the largest.
    """

    max_expected_error: Annotated[float, Range(above=0)] = 0.02
    max_hole: Annotated[float, Range(least=0)] = 1.0
    max_stretch: Annotated[float, Range(above=1)] = 10.0
    min_piece: Annotated[float, Range(least=0, most=1)] = 0.01

    def __post_init__(self) -> None:
        require_ranges(self)
