"""Settings of the fusion."""

from dataclasses import dataclass
from typing import Annotated

from pimper_torch.runtime.config import Range, require, require_ranges

KINDS = (
    *("kept_slopes", "cloud_points", "contour_rays", "swept_heights"),
    *("normals", "prior_normals", "prior_depths"),
)
"""Kinds of terms, in the order in which they are summed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FuseConfig:
    """Terms of the fusion, and the estimation of their noise.

    Attributes:
        samples_per_vertex: Template samples between neighbouring vertices of the surface, at the
            finest spacing. Time and memory decrease with its square.
        max_lost: Fraction of the variance of a facet's normals, or of its swept heights, that its
            grid may lose, see :mod:`~pimper_torch.stages.fusion.detail`. At twice or four times the
            spacing it has a quarter or a sixteenth of the vertices. 0 spaces all vertices equally.
        terms: Kinds of terms, in the order in which they are summed, see
            :mod:`~pimper_torch.stages.fusion.terms`.
        bias_iterations: Number of estimates of the tilt that the normals of a facet share, and of
            the variance of the error that its swept heights share; 0 treats all errors as
            independent.
        noise_iterations: Number of solves in which the noise of each kind of terms is estimated and
            outliers lose weight: for each estimate of the tilt and for the expected error, on a
            coarser subdivision, and once at full size. The coarse shape takes one more solve.
        error_draws: Number of noise samples ``n`` for the expected error of every vertex; its
            relative standard error is ``1 / sqrt(2 n)``, a quarter for 8. 0 disables it.
    """

    samples_per_vertex: float = 1.0
    max_lost: Annotated[float, Range(least=0, most=1)] = 0.15
    terms: tuple[str, ...] = KINDS
    bias_iterations: Annotated[int, Range(least=0, most=1000)] = 2
    noise_iterations: Annotated[int, Range(least=1, most=1000)] = 3
    error_draws: Annotated[int, Range(least=0, most=1000)] = 8

    def __post_init__(self) -> None:
        require_ranges(self, "fuse")
        samples = self.samples_per_vertex
        # The number of vertices is proportional to the inverse square: 16 per sample are enough.
        in_range = 0.25 <= samples <= 65_535
        require(in_range, "fuse.samples_per_vertex", samples, "at least 0.25, at most 65,535")
        known = set(self.terms) <= set(KINDS) and len(set(self.terms)) == len(self.terms) > 0
        require(known, "fuse.terms", self.terms, f"some of {', '.join(KINDS)}, each once")
