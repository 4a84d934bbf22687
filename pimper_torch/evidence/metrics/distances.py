"""Distances between two surfaces, in both directions: accuracy, completeness and kin."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.evidence.metrics.calibration import Calibration, calibrate
from pimper_torch.evidence.metrics.sampling import sample_surface
from pimper_torch.evidence.metrics.visible import count_seeing
from pimper_torch.geometry.nearest import NearestSurface
from pimper_torch.records import Capture, Mesh, Record


@dataclass(frozen=True, slots=True, kw_only=True)
class DistanceFigures(Record):
    """Distances of samples of one surface to the other.

    Attributes:
        mean: Scene units.
        median: Scene units.
        mean_percent: Of the diagonal of the true object's bounding box.
        samples: How many; each stands for the same area.
    """

    mean: float
    median: float
    mean_percent: float
    median_percent: float
    samples: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ThresholdFigures(Record):
    """How much of each surface lies near the other.

    Attributes:
        threshold: Scene units.
        threshold_percent: Of the diagonal.
        precision: Fraction of the estimate nearer to the truth than the threshold.
        recall: Fraction of the truth nearer to the estimate than the threshold.
        f_score: Their harmonic mean; 0 if both are 0.
    """

    threshold: float
    threshold_percent: float
    precision: float
    recall: float
    f_score: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TwoSided(Record):
    """Figures of both directions, for the whole truth or for a part of it.

    Attributes:
        completeness: From the truth to the estimate.
        chamfer_mean: Mean of mean accuracy and mean completeness, scene units.
        chamfer_sum: Their sum, which other papers call Chamfer distance.
        chamfer_mean_percent: Of the diagonal.
        chamfer_sum_percent: Of the diagonal.
    """

    completeness: DistanceFigures
    chamfer_mean: float
    chamfer_sum: float
    chamfer_mean_percent: float
    chamfer_sum_percent: float
    thresholds: tuple[ThresholdFigures, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceComparison(Record):
    """How a surface compares with the true one.

    Attributes:
        diagonal: Of the true object's bounding box along the axes of the truth, scene units.
        accuracy: From the estimate to the truth; ``None`` if all of it belongs to the
            surroundings.
        surroundings_fraction: Fraction of the estimate that lies nearer to the truth's
            surroundings than to the object, and is left out of the accuracy.
        seen: With that of the truth seen from at least ``seen_from`` positions; ``None`` if
            it is unknown, or none is.
        seen_from: How many positions of the camera.
        seen_fraction: Fraction of the truth that is seen so; ``None`` if unknown.
        calibration: Of the estimate's expected error, over its samples that count for the
            accuracy; ``None`` if it tells none.
    """

    diagonal: float
    accuracy: DistanceFigures | None
    surroundings_fraction: float
    whole: TwoSided | None
    seen: TwoSided | None
    seen_from: int
    seen_fraction: float | None
    calibration: Calibration | None = None


class TrueSurface:
    """The true surface prepared for the comparison with any number of estimates.

    Samples are drawn evenly over each surface, and each is compared with the nearest point
    of the other surface itself, not with its samples or vertices. Points stand for the
    surface where one has no faces.

    Args:
        capture: With the true mesh or points, and its cameras for what is seen.
        seen_from: How many positions of the camera must see a true point that is counted as
            seen; see :func:`pimper_torch.evidence.metrics.visible.count_seeing`.

    Raises:
        InputError: There is no true surface, or it has no extent.
    """

    def __init__(
        self, capture: Capture, *, seen_from: int = 3, samples: int = 200_000, seed: int = 0
    ) -> None:
        truth, surroundings = true_surface(capture), capture.truth.surroundings
        self.diagonal = bounding_diagonal(truth)
        self._generator = torch.Generator().manual_seed(seed)
        drawn = sample_surface(truth, samples, self._generator)
        count = count_seeing(drawn, capture, self.diagonal)
        self._points, self._samples = drawn.points, samples
        self._state = self._generator.get_state()
        self._seen, self._seen_from = None if count is None else count >= seen_from, seen_from
        self._object = NearestSurface(truth)
        self._surroundings = None
        if surroundings is not None and len(surroundings.vertices_world):
            self._surroundings = NearestSurface(surroundings)

    def compare(
        self, mesh: Mesh, thresholds_percent: Sequence[float] = (0.25, 0.5, 1.0)
    ) -> SurfaceComparison:
        """Measure the distances between an estimate and the truth, area by area.

        Args:
            mesh: The estimate, in the frame of the truth.
            thresholds_percent: Of the diagonal, for precision, recall and F-score.

        Raises:
            InputError: The estimate has no extent.
        """
        self._generator.set_state(self._state)  # the order of the estimates changes nothing
        drawn = sample_surface(mesh, self._samples, self._generator)
        ours = drawn.points
        to_truth = self._object.query(ours).distance
        aside = torch.zeros(len(ours), dtype=torch.bool)
        if self._surroundings is not None:
            aside = self._surroundings.query(ours).distance < to_truth
        to_truth = to_truth[~aside]
        calibration = None
        if mesh.expected_error is not None:
            calibration = calibrate(drawn.interpolate(mesh.expected_error)[~aside], to_truth)
        to_estimate = NearestSurface(mesh).query(self._points).distance

        def two_sided(distances: Float[Tensor, " sample"]) -> TwoSided | None:
            if len(distances) == 0 or len(to_truth) == 0:
                return None
            return _two_sided(to_truth, distances, self.diagonal, thresholds_percent)

        seen = self._seen
        return SurfaceComparison(
            diagonal=self.diagonal,
            accuracy=_figures(to_truth, self.diagonal) if len(to_truth) else None,
            surroundings_fraction=float(aside.double().mean()),
            whole=two_sided(to_estimate),
            seen=None if seen is None else two_sided(to_estimate[seen]),
            seen_from=self._seen_from,
            seen_fraction=None if seen is None else float(seen.double().mean()),
            calibration=calibration,
        )


def true_surface(capture: Capture) -> Mesh:
    """Return the true mesh of the object, or its points as a mesh without faces."""
    truth = capture.truth
    if truth.mesh is not None:
        return truth.mesh
    if truth.points_world is not None:
        return Mesh(vertices_world=truth.points_world, faces=torch.zeros(0, 3, dtype=torch.long))
    raise InputError("the truth has neither a mesh nor points, so no distance can be measured.")


def bounding_diagonal(mesh: Mesh) -> float:
    """Return the diagonal of the box, along the axes of the world, round what a mesh shows.

    Vertices without a face count only where there are no faces at all.
    """
    vertices = mesh.vertices_world.double()
    used = vertices[torch.unique(mesh.faces)] if len(mesh.faces) else vertices
    return float((used.amax(dim=0) - used.amin(dim=0)).norm())


def _two_sided(
    to_truth: Float[Tensor, " ours"],
    to_estimate: Float[Tensor, " theirs"],
    diagonal: float,
    thresholds_percent: Sequence[float],
) -> TwoSided:
    accuracy, completeness = _figures(to_truth, diagonal), _figures(to_estimate, diagonal)
    total = accuracy.mean + completeness.mean
    return TwoSided(
        completeness=completeness,
        chamfer_mean=total / 2,
        chamfer_sum=total,
        chamfer_mean_percent=50 * total / diagonal,
        chamfer_sum_percent=100 * total / diagonal,
        thresholds=tuple(
            _at_threshold(to_truth, to_estimate, percent, diagonal)
            for percent in thresholds_percent
        ),
    )


def _at_threshold(
    to_truth: Float[Tensor, " ours"],
    to_estimate: Float[Tensor, " theirs"],
    percent: float,
    diagonal: float,
) -> ThresholdFigures:
    threshold = percent / 100 * diagonal
    precision = float((to_truth < threshold).double().mean())
    recall = float((to_estimate < threshold).double().mean())
    both = precision + recall
    return ThresholdFigures(
        threshold=threshold,
        threshold_percent=percent,
        precision=precision,
        recall=recall,
        f_score=2 * precision * recall / both if both > 0 else 0.0,
    )


def _figures(distances: Float[Tensor, " sample"], diagonal: float) -> DistanceFigures:
    mean, median = float(distances.mean()), float(distances.median())
    return DistanceFigures(
        mean=mean,
        median=median,
        mean_percent=100 * mean / diagonal,
        median_percent=100 * median / diagonal,
        samples=len(distances),
    )
