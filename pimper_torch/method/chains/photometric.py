"""What the method does on each patch by itself: samples, normals under the light, and heights."""

from collections.abc import Callable, Mapping
from typing import Protocol, runtime_checkable

from pimper_torch.ground.geometry.pyramids import Sources
from pimper_torch.method.photometry.fit_light import Illumination
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
from pimper_torch.runtime.reporting import add_counts, figures, part
from pimper_torch.runtime.stage import Stage

Factorizing = Callable[[PatchViews, Illumination], PhotometricPatches]


@runtime_checkable
class Warping(Protocol):
    """A stage that resamples all views on templates."""

    def __call__(
        self, views: Views, cameras: Cameras, patches: PatchSet, sources: Sources | None = None, /
    ) -> PatchViews:
        """Return the samples J of every patch, and which of them are missing."""


@runtime_checkable
class Sweeping(Protocol):
    """A stage that finds heights under the fitted light."""

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
    """Warp, factorize and sweep all patches, few at a time.

    A patch needs nothing of others but the light. The samples J exist for as many buckets as are
    worked on side by side, and no more: all of them take more memory than there is.
    """

    name = "photometry"

    def __init__(self, warp: Warping, factorize: Factorizing, sweep: Sweeping) -> None:
        super().__init__()
        self.warp, self.factorize, self.sweep = warp, factorize, sweep

    def forward(
        self,
        views: Views,
        cameras: Cameras,
        patches: PatchSet,
        light: Illumination,
        sources: Sources | None = None,
    ) -> SweptPatches:
        """Return heights, with the normals, albedo and lights that they were swept under.

        Args:
            sources: The photographs, prepared for both stages.
        """

        def of_bucket(templates: Templates) -> SweptPatches:
            some = patches.replace(buckets=(templates,))
            with part("warp"):
                seen = self.warp(views, cameras, some, sources)  # samples J
            add_counts(figures(seen))
            with part("factorize"):
                photometric = self.factorize(seen, light)  # J = L N: lights, albedo and normals
            with part("sweep"):
                return self.sweep(views, cameras, seen, photometric, sources)

        parts = list(side_by_side(of_bucket, patches.buckets))
        lit = tuple(one for each in parts for one in each.photometric.buckets)
        swept = SweptPatches(
            photometric=PhotometricPatches(patches=patches, buckets=lit),
            buckets=tuple(one for each in parts for one in each.buckets),
            averaged=parts[0].averaged,
        )
        warn_of_priors(figures(swept))
        release_memory()
        return swept


def warn_of_priors(told: Mapping[str, int | float]) -> None:
    """Warn of priors that are far from the estimates of the photographs."""
    for what in ("normals", "depths"):
        over = told.get(f"prior_{what}_over_claim", 0.0)
        if over > 3:
            caution(
                f"Prior {what} are {over:.1f} times as far from what the photographs tell as both "
                "claim: they count for less. Look whether they are of these photographs, and how "
                "far off they are said to be."
            )
