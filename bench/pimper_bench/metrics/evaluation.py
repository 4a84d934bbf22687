"""A result against the truth: every figure that the truth allows."""

from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_bench.metrics import camera_errors, similarity
from pimper_bench.metrics.dtu_protocol import DtuFigures, dtu_figures
from pimper_bench.metrics.frames import Frames
from pimper_bench.metrics.in_view import ViewFigures, compare_along_rays
from pimper_bench.metrics.surface_distances import (
    SurfaceComparison,
    TrueSurface,
    true_surface,
)
from pimper_bench.truth import Capture, DtuProtocol
from pimper_torch.records import Estimate, Record
from pimper_torch.runtime.config import Range, require, require_ranges
from pimper_torch.runtime.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluateConfig:
    """Settings of an evaluation.

    Attributes:
        alignment: Before measuring: `none`, `cameras` (similarity on the cameras both have),
            `icp` (trimmed similarity between the surfaces, from the cameras or a guess at units,
            axes and a shift on), or `auto`: cameras if there are two on both sides, else none.
        views: Names of the photographs to compare normals, albedo and relative error in; the
            result's reference view unless given, or the middle one if it has none.
        thresholds_percent: For precision, recall and F-score, in per cent of the diagonal of
            the true object's bounding box.
        seen_from: Completeness is given once more over the truth that this many positions of the
            camera see.
        samples: Points drawn on each surface.
        seed: Of every draw.
        trimmed_fraction: Fraction of the result's samples that each step of `icp` leaves out.
    """

    alignment: similarity.Method = "auto"
    views: tuple[str, ...] = ()
    thresholds_percent: tuple[float, ...] = (0.25, 0.5, 1.0)
    seen_from: Annotated[int, Range(least=1, most=100_000)] = 3
    samples: Annotated[int, Range(least=1, most=10_000_000)] = 200_000  # 100 bytes each
    seed: Annotated[int, Range(least=0, most=2**32 - 1)] = 0  # 32 bits
    trimmed_fraction: Annotated[float, Range(least=0, below=1)] = 0.2

    def __post_init__(self) -> None:
        within = all(0 < percent <= 100 for percent in self.thresholds_percent)
        require(within, "thresholds_percent", self.thresholds_percent, "above 0, at most 100 each")
        require_ranges(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation(Record):
    """All figures; a part is ``None`` (or empty) where either side lacks what it needs.

    Those of the cameras are after the similarity on cameras, all others after ``alignment``.
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
    """Measure a result by everything the truth determines; views are paired by :func:`.pair_views`.

    Args:
        capture: The truth; its views may be a part of those the estimate was made from.
        surface: That of ``capture``, where many estimates are measured against it; see
            :func:`prepared_surface`.
        maps: The same data set with the maps of the views to compare in, where ``capture``
            was read without any to save memory.
        dtu: Evaluation region of a scan of the DTU set; needs the scan's points.

    Raises:
        InputError: The alignment cannot be made, a view that was asked for is unknown, or
            the surfaces are in different frames; see :class:`.Frames`.
    """
    config = config or EvaluateConfig()
    generator = torch.Generator().manual_seed(config.seed)
    alignment = similarity.align_estimate(
        estimate, capture, config.alignment, config.trimmed_fraction, generator=generator
    )
    moved = similarity.transfer(estimate.mesh, alignment.truth_from_world)
    if _knows_surface(capture):
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
    if not _knows_surface(capture):
        return None
    return TrueSurface(
        capture, seen_from=config.seen_from, samples=config.samples, seed=config.seed
    )


def _knows_surface(capture: Capture) -> bool:
    return capture.truth.mesh is not None or capture.truth.points_world is not None


def chosen_views(estimate: Estimate, capture: Capture, config: EvaluateConfig) -> tuple[int, ...]:
    """Return the indices of the views to compare in."""
    names = capture.views.names
    chosen: dict[int, None] = {}
    for asked in config.views:
        try:
            chosen[int(similarity.pair_views([asked], names)[1][0])] = None
        except InputError as error:
            raise InputError(
                f"there is no view {asked!r} in the truth; it has {', '.join(names[:5])}"
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
    """Compare the cameras of the views that both have.

    Returns:
        ``None`` for fewer than two, or where they agree but for their rolls.
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
        surface=true_surface(capture) if _knows_surface(capture) else None,
    )
