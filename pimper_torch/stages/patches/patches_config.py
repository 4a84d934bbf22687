"""Settings of the decomposition and the warp."""

from dataclasses import dataclass
from typing import Annotated

from pimper_torch.radiometry import SATURATED
from pimper_torch.runtime.config import Range, require, require_ranges


@dataclass(frozen=True, slots=True, kw_only=True)
class DecomposeConfig:
    """Sample spacing, overlap and views of the templates.

    Attributes:
        samples_per_pixel: Template samples per pixel of the reference view; the paper's
            zeta, made independent of the scene's unit.
        overlap_samples: Distance, in samples, by which each edge is moved outward.
        num_views: Largest number of views of a facet. If more face it, a block of facets uses its
            best views, spread in direction.
        max_samples: Largest number of samples of all facets in all views that they face, at most
            ``num_views`` each; the spacing is increased to meet it. Bounds time and memory;
            infinite for no limit.
        bucket_entries: Samples times views of a batch of templates, to fit a processor's cache.
    """

    samples_per_pixel: Annotated[float, Range(above=0, most=8)] = 1.0
    overlap_samples: Annotated[float, Range(least=1, most=65_535)] = 2.0  # the widest photograph
    num_views: Annotated[int, Range(least=3, most=100_000)] = 40
    max_samples: Annotated[float, Range(least=1)] = 4.5e7
    bucket_entries: Annotated[int, Range(least=1, most=100_000_000)] = 300_000  # 100 bytes each

    def __post_init__(self) -> None:
        require_ranges(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class WarpConfig:
    """Criteria for valid samples of a view.

    Attributes:
        dark_level: Radiance at or below which a sample is invalid; 1 is saturation.
        saturation_level: Radiance of any channel at or above which a pixel is invalid.
        max_tilt_deg: Largest angle between the normal and the direction to the view.
        occlusion_stride: Distance in samples between the rays that test for occlusion.
    """

    dark_level: Annotated[float, Range(least=0, below=1)] = 0.01
    saturation_level: float = SATURATED
    max_tilt_deg: Annotated[float, Range(above=0, below=90)] = 75.0
    occlusion_stride: Annotated[int, Range(least=1, most=65_535)] = 4

    def __post_init__(self) -> None:
        require_ranges(self)
        require(
            self.saturation_level > self.dark_level,
            "saturation_level",
            self.saturation_level,
            f"above dark_level {self.dark_level}",
        )
