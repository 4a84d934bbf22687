"""Warp, factorization and sweep of all patches, a few at a time.

A patch needs nothing of others but the light field, which is fitted first, to few samples of all
patches, and the scale of albedo, which is set last. So the matrices J exist for as many buckets as
are worked on side by side, and no more.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import Lock
from typing import Protocol, runtime_checkable

from pimper_torch.errors import caution
from pimper_torch.parallel import side_by_side
from pimper_torch.patches.sources import Sources
from pimper_torch.photometry.factorize import Illumination
from pimper_torch.photometry.lights import thinned
from pimper_torch.records import (
    Cameras,
    Heights,
    PatchSet,
    PatchViews,
    PhotometricPatches,
    Photometry,
    Record,
    SweptPatches,
    Templates,
    Views,
)
from pimper_torch.reporting import called, figures, stage


@runtime_checkable
class InParts(Protocol):
    """A factorization that can be called with some of the patches."""

    def light(self, seen: PatchViews) -> Illumination:
        """Fit the light of every view to views on templates that may be thinned."""

    def solve(self, seen: PatchViews, light: Illumination) -> PhotometricPatches:
        """Factorize some of the patches."""

    def conclude(self, solved: PhotometricPatches) -> PhotometricPatches:
        """Do what needs all patches."""


@runtime_checkable
class Prepares(Protocol):
    """A warp that prepares photographs for any number of calls."""

    def prepare(self, views: Views) -> Sources:
        """Prepare them."""


Factorizing = Callable[[PatchViews], PhotometricPatches]


@runtime_checkable
class Warping(Protocol):
    """A stage that resamples all views on all templates."""

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


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Bucket(Record):
    """Photometry and heights of a bucket."""

    photometry: Photometry
    heights: Heights
    averaged: float
    num_valid: int


def photometry_and_heights(
    warp: Warping,
    factorize: Factorizing,
    sweep: Sweeping,
    views: Views,
    cameras: Cameras,
    patches: PatchSet,
    sources: Sources | None = None,
) -> SweptPatches:
    """Return normals, albedo, light and swept heights of all patches.

    What the three stages give one after the other, called with all patches, but for the samples
    that light is fitted to; a factorization that is not :class:`InParts` is called so.

    Args:
        sources: The photographs as the warp prepares them, and the surface that occludes.

    Differentiable as the stages are.
    """
    if not isinstance(factorize, InParts):
        seen = called("warp", warp, views, cameras, patches, sources)
        photometric = called("factorize", factorize, seen)
        return called("sweep", sweep, views, cameras, seen, photometric, sources)
    with stage("photometry") as told:
        clock = _Clock()
        light = factorize.light(warp(views, cameras, thinned(patches), sources))

        def one(templates: Templates) -> _Bucket:
            part = patches.replace(buckets=(templates,))
            with clock("warp"):
                seen = warp(views, cameras, part, sources)
            with clock("factorize"):
                solved = factorize.solve(seen, light)
            with clock("sweep"):
                swept = sweep(views, cameras, seen, solved, sources)
            return _Bucket(
                photometry=solved.buckets[0],
                heights=swept.buckets[0],
                averaged=swept.averaged,
                num_valid=int(seen.buckets[0].valid.count_nonzero()),
            )

        found = list(side_by_side(one, patches.buckets))
        solved = PhotometricPatches(
            patches=patches, buckets=tuple(bucket.photometry for bucket in found)
        )
        photometric = factorize.conclude(solved)
        samples = sum(
            int(each.inside.sum()) * bucket.photometry.lights_patch.shape[1]
            for each, bucket in zip(patches.buckets, found, strict=True)
        )
        told["samples"] = samples
        told["missing_fraction"] = 1 - sum(bucket.num_valid for bucket in found) / max(1, samples)
        told.update(figures(photometric))
        told.update(clock.fractions())
        swept = SweptPatches(
            photometric=photometric,
            buckets=tuple(bucket.heights for bucket in found),
            averaged=found[0].averaged,
        )
        told.update(off := figures(swept))
    warn_of_priors(off)
    return swept


def warn_of_priors(told: Mapping[str, int | float]) -> None:
    """Warn of priors that are far from what the photographs tell."""
    for what in ("normals", "depths"):
        over = told.get(f"prior_{what}_over_claim", 0.0)
        if over > 3:
            caution(
                f"Prior {what} are {over:.1f} times as far from what the photographs tell as both "
                "claim: they count for less. Look whether they are of these photographs, and how "
                "far off they are said to be."
            )


@dataclass(slots=True)
class _Clock:
    """Adds up what parts of the work take, whichever thread does them."""

    seconds: dict[str, float] = field(default_factory=dict)
    lock: Lock = field(default_factory=Lock)

    @contextmanager
    def __call__(self, part: str) -> Iterator[None]:
        began = time.perf_counter()
        yield
        took = time.perf_counter() - began
        with self.lock:
            self.seconds[part] = self.seconds.get(part, 0.0) + took

    def fractions(self) -> dict[str, float]:
        """Return each part's fraction of the whole."""
        whole = sum(self.seconds.values()) or 1.0
        return {f"{part}_share": took / whole for part, took in self.seconds.items()}
