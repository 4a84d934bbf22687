"""Evaluation of a result against ground truth: every figure that the truth allows."""

from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_bench.metrics import camera_errors, similarity
from pimper_bench.metrics.dtu_protocol import DtuFigures, dtu_figures
from pimper_bench.metrics.estimates import Estimate
from pimper_bench.metrics.frames import Frames
from pimper_bench.metrics.in_view import ViewFigures, compare_along_rays
from pimper_bench.metrics.surface_distances import (
    SurfaceComparison,
    TrueSurface,
    true_surface,
)
from pimper_bench.truth import Capture, DtuProtocol
from pimper_torch.records import Record
from pimper_torch.runtime.config import Range, require, require_ranges
from pimper_torch.runtime.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluateConfig:
    """Settings of an evaluation.

    Attributes:
        alignment: Before measuring: `none`, `cameras` (similarity between the common cameras),
            `icp` (trimmed similarity ICP of the surfaces, starting from the cameras or a guess of
            units, axes and translation), or `auto`: cameras if at least two are common, else none.
        views: Names of the photographs in which normals, albedo and relative error are compared;
            by default the result's reference view, or the middle one if it has none.
        thresholds_percent: For precision, recall and F-score, in per cent of the diagonal of
            the true object's bounding box.
        seen_from: Completeness is repeated over the part of the truth that is visible from at least
            this many camera positions.
        samples: Number of points drawn on each surface.
        seed: Of all random samples.
        trimmed_fraction: Fraction of the result's samples that each step of `icp` excludes.
    """

    alignment: similarity.Method = "auto"
    views: tuple[str, ...] = ()
    thresholds_percent: tuple[float, ...] = (0.25, 0.5, 1.0)
    seen_from: Annotated[int, Range(least=1, most=100_000)] = 3
    samples: Annotated[int, Range(least=1, most=10_000_000)] = 200_000  # 100 bytes each
    seed: Annotated[int, Range(least=0, most=2**32 - 1)] = 0  # 32 bits
    trimmed_fraction: Annotated[float, Range(least=0, below=1)] = 0.2

    def __post_init__(self) -> None:
        valid = all(0 < percent <= 100 for percent in self.thresholds_percent)
        require(valid, "thresholds_percent", self.thresholds_percent, "above 0, at most 100 each")
        require_ranges(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation(Record):
    """All figures; ``None`` (or empty) if either side lacks the required data.

    Figures of the cameras are after the similarity on cameras, all others after ``alignment``.
    """

    alignment: similarity.Alignment
    surface: SurfaceComparison | None
    views: tuple[ViewFigures, ...]
    lights: camera_errors.LightFigures | None
    cameras: camera_errors.CameraFigures | None
    dtu: DtuFigures | None


def evaluate(
    estimate: Estimate,
    capture: Capture,
    config: EvaluateConfig | None = None,
    *,
    surface: TrueSurface | None = None,
    maps: Capture | None = None,
    dtu: DtuProtocol | None = None,
) -> Evaluation:
    """Compute every figure that the truth determines; views are paired by :func:`.pair_views`.

    Args:
        capture: The truth; its views may be a subset of the estimate's.
        surface: That of ``capture``, to be reused for several estimates; see
            :func:`prepared_surface`.
        maps: The same data set with the maps of the compared views, if ``capture`` was read
            without maps to save memory.
        dtu: Evaluated region of a scan of the DTU set; needs the scan's points.

    Raises:
        InputError: The alignment is impossible, a requested view is unknown, or
            the surfaces are in different frames; see :class:`.Frames`.
    """
    config = config or EvaluateConfig()
    generator = torch.Generator().manual_seed(config.seed)
    alignment = similarity.align_estimate(
        estimate, capture, config.alignment, config.trimmed_fraction, generator=generator
    )
    moved = similarity.transfer(estimate.mesh, alignment.truth_from_world)
    if _has_surface(capture):
        pairs = similarity.paired_cameras(estimate, capture)
        cameras = 0 if pairs is None else pairs[0].num_views
        Frames(moved, true_surface(capture)).require_met(alignment.method, cameras)
    surface = surface or prepared_surface(capture, config)
    maps = maps or capture
    compared = (
        compare_along_rays(moved, maps, view) for view in chosen_views(estimate, maps, config)
    )
    figures = None
    if dtu is not None and capture.truth.points_world is not None:
        figures = dtu_figures(moved, capture.truth.points_world, dtu, generator)
    return Evaluation(
        alignment=alignment,
        surface=surface.compare(moved, config.thresholds_percent) if surface else None,
        views=tuple(view for view in compared if view is not None),
        lights=_lights(estimate, capture, alignment.truth_from_world),
        cameras=camera_figures(estimate, capture),
        dtu=figures,
    )


def prepared_surface(capture: Capture, config: EvaluateConfig) -> TrueSurface | None:
    """Prepare the true surface for :func:`evaluate`; ``None`` if it is unknown."""
    if not _has_surface(capture):
        return None
    return TrueSurface(
        capture, seen_from=config.seen_from, samples=config.samples, seed=config.seed
    )


def _has_surface(capture: Capture) -> bool:
    return capture.truth.mesh is not None or capture.truth.points_world is not None


def chosen_views(estimate: Estimate, capture: Capture, config: EvaluateConfig) -> tuple[int, ...]:
    """Return the indices of the compared views."""
    names = capture.views.names
    chosen: dict[int, None] = {}
    for name in config.views:
        try:
            chosen[int(similarity.pair_views([name], names)[1][0])] = None
        except InputError as error:
            raise InputError(
                f"there is no view {name!r} in the truth; it has {', '.join(names[:5])}"
                f"{', ...' if len(names) > 5 else ''}. Choose one of these."
            ) from error
    if not chosen and estimate.reference is not None:
        with suppress(InputError):
            chosen[int(similarity.pair_views([estimate.reference], names)[1][0])] = None
    return tuple(chosen) or ((len(names) // 2,) if names else ())


def _lights(
    estimate: Estimate, capture: Capture, truth_from_world: Float[Tensor, "4 4"]
) -> camera_errors.LightFigures | None:
    lights, truth = estimate.lights_world, capture.truth.lights_world
    if lights is None or truth is None:
        return None
    try:
        ours, theirs = similarity.pair_views(estimate.names, capture.views.names)
    except InputError:
        return None
    return camera_errors.compare_lights(
        lights[ours], truth[theirs], similarity.split_similarity(truth_from_world)[1]
    )


def camera_figures(estimate: Estimate, capture: Capture) -> camera_errors.CameraFigures | None:
    """Compare the cameras of the common views.

    Returns:
        ``None`` for fewer than two, or if they agree except for their rolls.
    """
    pairs = similarity.paired_cameras(estimate, capture)
    if pairs is None or pairs[0].num_views < 2 or similarity.rolled_cameras(*pairs):
        return None
    ours, truth = pairs
    return camera_errors.compare_cameras(
        ours,
        truth,
        similarity.similarity_between_cameras(ours, truth),
        views=capture.views.num_views,
        surface=true_surface(capture) if _has_surface(capture) else None,
    )
