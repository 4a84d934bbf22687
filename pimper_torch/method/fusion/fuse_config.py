"""Settings of the fusion."""

from dataclasses import dataclass
from typing import Annotated

from pimper_torch.runtime.config import Range, require, require_ranges

KINDS = (
    *("kept_slopes", "cloud_points", "contour_rays", "swept_heights"),
    *("normals", "prior_normals", "prior_depths"),
)
"""Kinds of evidence, in the order that they are summed up."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FuseConfig:
    """Which terms take part, and how the noise of each kind is estimated.

    Attributes:
        samples_per_vertex: Template samples between neighbouring vertices of the surface, where
            they lie closest. Time and memory fall with its square.
        max_lost: Part of the variance of a facet's normals, or of its swept heights, that its grid
            may lose, see :mod:`~pimper_torch.method.fusion.detail`. Of twice or four times the
            spacing it has a quarter or a sixteenth of the vertices. 0 spaces all alike.
        terms: Kinds of evidence, in the order that they are summed up, see
            :mod:`~pimper_torch.method.fusion.terms`.
        bias_iterations: How often the tilt that the normals of a facet have in common, and the
            variance of the error that its swept heights have in common, are estimated; 0 takes
            all errors for independent.
        noise_iterations: Solves in which the noise of each kind of terms is estimated and
            outliers lose weight: for each estimate of the tilt, and for the expected error, on a
            coarser subdivided mesh, and once at full size. The coarse shape takes one more.
        error_draws: Of noise, for the expected error of every vertex; its relative standard error
            is one over the square root of twice as many, a quarter for 8. 0 gives none.
    """

    samples_per_vertex: float = 1.0
    max_lost: Annotated[float, Range(least=0, most=1)] = 0.15
    terms: tuple[str, ...] = KINDS
    bias_iterations: Annotated[int, Range(least=0, most=1000)] = 2
    noise_iterations: Annotated[int, Range(least=1, most=1000)] = 3
    error_draws: Annotated[int, Range(least=0, most=1000)] = 8

    def __post_init__(self) -> None:
        require_ranges(self, "fuse")
        each = self.samples_per_vertex
        # The number of vertices goes with the square: 16 a sample tell all that it says.
        sound = 0.25 <= each <= 65_535
        require(sound, "fuse.samples_per_vertex", each, "at least 0.25, at most 65,535")
        known = set(self.terms) <= set(KINDS) and len(set(self.terms)) == len(self.terms) > 0
        require(known, "fuse.terms", self.terms, f"some of {', '.join(KINDS)}, each once")
