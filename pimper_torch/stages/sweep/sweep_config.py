"""Settings of the sweep."""

from dataclasses import dataclass
from typing import Annotated

from pimper_torch.runtime.config import Range, require, require_ranges


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepConfig:
    """Number of heights, and of views in which they are compared.

    Attributes:
        steps: Number of heights on each side of the template.
        num_views: Largest number of views in which a sample is compared: those with the best
            angle, resolution and light.
        min_views: Samples in fewer usable views, of distinct poses, get no height.
    """

    steps: Annotated[int, Range(least=1, most=1000)] = 4
    num_views: Annotated[int, Range(least=2, most=100_000)] = 16
    min_views: Annotated[int, Range(least=2)] = 3

    def __post_init__(self) -> None:
        require_ranges(self, "sweep")
        least = self.min_views
        require(self.num_views >= least, "sweep.num_views", self.num_views, "min_views or more")
