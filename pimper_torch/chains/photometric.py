"""Stages that process each patch separately: samples, photometric normals, and heights."""

from collections.abc import Callable, Mapping
from typing import Protocol, runtime_checkable

from pimper_torch.geometry.pyramids import Sources
from pimper_torch.kernels.compile import SWEEP
from pimper_torch.records import (
    Cameras,
    PatchSet,
    PatchViews,
    PhotometricPatches,
    SweptPatches,
    Templates,
    Views,
)
from pimper_torch.runtime.errors import caution
from pimper_torch.runtime.memory import release_memory
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.runtime.reporting import add_counts, timed
from pimper_torch.stages.photometry.fit_light import Illumination
from pimper_torch.stages.stage import Stage

Factorizing = Callable[[PatchViews, Illumination], PhotometricPatches]


@runtime_checkable
class WarpStage(Protocol):
    """A stage that resamples all views on templates."""

    def __call__(
        self, views: Views, cameras: Cameras, patches: PatchSet, sources: Sources | None = None, /
    ) -> PatchViews:
        """Return the samples J of every patch, and the mask D of valid ones."""


@runtime_checkable
class SweepStage(Protocol):
    """A stage that sweeps heights under the fitted light."""

    def __call__(
        self,
        views: Views,
        cameras: Cameras,
        seen: PatchViews,
        photometric: PhotometricPatches,
        sources: Sources | None = None,
        /,
    ) -> SweptPatches:
        """Return the heights of every patch."""


class Photometric(Stage):
    """Warp, factorize and sweep all patches, a few buckets at a time.

    Patches are independent of each other given the light. Samples J exist only for the buckets
    processed in parallel, because those of all patches do not fit into memory.
    """

    kept_as = SweptPatches
    kernels = SWEEP

    def forward(
        self,
        stages: tuple[WarpStage, Factorizing, SweepStage],
        views: Views,
        cameras: Cameras,
        patches: PatchSet,
        light: Illumination,
        sources: Sources | None = None,
    ) -> SweptPatches:
        """Return the swept heights of all patches, with their normals, albedo and lights.

        Args:
            stages: Warp, factorization and sweep of a bucket.
            sources: Image pyramids of the photographs, for warp and sweep.
        """
        warp, factorize, sweep = stages

        def of_bucket(templates: Templates) -> SweptPatches:
            bucket = patches.replace(buckets=(templates,))
            with timed("warp"):
                seen = warp(views, cameras, bucket, sources)  # samples J
            add_counts(seen.figures())
            with timed("factorize"):
                photometric = factorize(seen, light)  # J = L N: lights, albedo and normals
            with timed("sweep"):
                return sweep(views, cameras, seen, photometric, sources)

        results = list(side_by_side(of_bucket, patches.buckets))
        lit = tuple(bucket for result in results for bucket in result.photometric.buckets)
        swept = SweptPatches(
            photometric=PhotometricPatches(patches=patches, buckets=lit),
            buckets=tuple(bucket for result in results for bucket in result.buckets),
            averaged=results[0].averaged,
        )
        warn_of_priors(swept.figures())
        release_memory()
        return swept


def warn_of_priors(counts: Mapping[str, int | float]) -> None:
    """Warn of priors that deviate from the photographs by far more than their standard errors."""
    for kind in ("normals", "depths"):
        ratio = counts.get(f"prior_{kind}_over_claim", 0.0)
        if ratio > 3:
            caution(
                f"Prior {kind} deviate from estimates of the photographs {ratio:.1f} times as much "
                "as the standard errors of both allow, and get less weight. Check that they belong "
                "to these photographs, and that the standard errors given with them are right."
            )
