"""Distances between two surfaces: accuracy, completeness, and calibration of expected errors."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.stats import spearmanr
from torch import Tensor
from torch.nn.functional import normalize

from pimper_bench.scenes.procedural_meshes import join
from pimper_bench.truth import Capture, Truth
from pimper_torch.geometry.nearest import NearestSurface
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import Cameras, Mesh, Record
from pimper_torch.runtime.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SurfaceSamples(Record):
    """Points on a surface, each representing the same area.

    Attributes:
        normals: Unit face normals; ``None`` for a point cloud.
        corners: Vertices of the points' faces; the vertex itself for a point cloud.
        fractions: Barycentric coordinates.
    """

    points: Float[Tensor, "sample 3"]
    normals: Float[Tensor, "sample 3"] | None
    corners: Int[Tensor, "sample corner"]
    fractions: Float[Tensor, "sample corner"]

    def interpolate(self, per_vertex: Float[Tensor, " vertex"]) -> Float[Tensor, " sample"]:
        """Interpolate vertex values of the surface."""
        values = per_vertex.detach().to(self.fractions)[self.corners]
        return (self.fractions * values).sum(dim=1)


def sample_surface(mesh: Mesh, count: int, generator: torch.Generator) -> SurfaceSamples:
    """Sample points uniformly by area; of a point cloud, ``count`` points without repetition.

    Stratified: the concatenated areas of the faces are cut in ``count`` equal pieces, with one
    point in each.
    """
    vertices = mesh.vertices_world.detach().cpu().double()
    faces = mesh.faces.cpu()
    if len(vertices) == 0:
        raise InputError("the surface has no vertices; needed: a mesh or a point cloud.")
    if len(faces) == 0:
        chosen = torch.randperm(len(vertices), generator=generator)[:count]
        corners = chosen[:, None]
        return SurfaceSamples(
            points=vertices[chosen],
            normals=None,
            corners=corners,
            fractions=torch.ones_like(corners, dtype=torch.float64),
        )
    normals = face_normals(vertices, faces)
    ends = normals.norm(dim=1).cumsum(dim=0)
    if not float(ends[-1]) > 0:
        raise InputError(
            f"all {len(faces)} faces of the surface are degenerate; needed: triangles with area."
        )
    face = _sampled_faces(ends, count, generator)
    # Reflecting at the unit square's diagonal keeps the density uniform on the triangle.
    u, v = torch.rand(2, count, generator=generator, dtype=torch.float64)
    fold = u + v > 1
    u, v = torch.where(fold, 1 - u, u), torch.where(fold, 1 - v, v)
    a, b, c = vertices[faces[face]].unbind(dim=1)
    points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    return SurfaceSamples(
        points=points,
        normals=normalize(normals[face], dim=1),
        corners=faces[face],
        fractions=torch.stack([1 - u - v, u, v], dim=1),
    )


def _sampled_faces(
    ends: Float[Tensor, " face"], count: int, generator: torch.Generator
) -> Int[Tensor, " sample"]:
    jitter = torch.rand(count, generator=generator, dtype=torch.float64)
    positions = (torch.arange(count) + jitter) / count * ends[-1]
    return torch.searchsorted(ends, positions, right=True).clamp_max(len(ends) - 1)


def count_seeing(
    samples: SurfaceSamples, capture: Capture, diagonal: float
) -> Int[Tensor, " sample"] | None:
    """Count the camera positions that see each true point.

    By ray casting on the true mesh with its surroundings; the face must face the camera. Views from
    one position (``capture.position``) count once.

    Args:
        diagonal: Of the object's bounding box, scene units.

    Returns:
        ``None`` without cameras or without a mesh.
    """
    mesh, cameras = capture.truth.mesh, capture.cameras
    if cameras is None or mesh is None or not len(mesh.faces):
        return None
    joined = with_surroundings(mesh, capture.truth)
    caster = RayCaster(joined.vertices_world, joined.faces)
    count = torch.zeros(len(samples.points), dtype=torch.long)
    for position in torch.unique(capture.position):
        view = int((capture.position == position).nonzero()[0])
        count += _visible(samples, cameras, view, caster, diagonal)
    return count


def _visible(
    samples: SurfaceSamples, cameras: Cameras, view: int, caster: RayCaster, diagonal: float
) -> Bool[Tensor, " sample"]:
    assert samples.normals is not None  # of a mesh
    points, center = samples.points, cameras.centers_world[view].to(samples.points)
    pixels, depth = project(
        points, cameras.cam_from_world[view].to(points), cameras.intrinsics[view].to(points)
    )
    size = cameras.sizes_px[view].to(points)
    visible = (depth > 0) & ((pixels >= 0) & (pixels < size)).all(dim=1)
    visible &= ((center - points) * samples.normals).sum(dim=1) > 0
    candidates = visible.nonzero()[:, 0]
    # The ray caster's single precision needs a margin of more than a millionth of the diagonal.
    visible[candidates[caster.occluded(points[candidates], center, 1e-3 * diagonal)]] = False
    return visible


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationBin(Record):
    """A tenth of the surface, by expected error; scene units.

    Attributes:
        expected: Root mean square of the expected errors.
        robust: Median of the true errors over 0.6745, the standard deviation of Gaussian
            noise with this median: insensitive to outliers.
    """

    expected: float
    root_mean_square: float
    robust: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration(Record):
    """Expected errors compared with true ones.

    Attributes:
        ratio: Median of true over expected error, over 0.6745: 1 for Gaussian noise of the
            expected standard deviation, above 1 if expected errors are too small.
        within_one: Fraction with a true error up to the expected one; 68 % for Gaussian noise.
        within_two: Fraction with a true error up to twice the expected one; 95 %.
        rank_correlation: Spearman's; NaN if all expected errors are equal.
        bins: Equal fractions of the surface, by increasing expected error.
    """

    ratio: float
    within_one: float
    within_two: float
    rank_correlation: float
    bins: tuple[CalibrationBin, ...]
    samples: int


def calibrate(
    expected: Float[Tensor, " sample"], true: Float[Tensor, " sample"]
) -> Calibration | None:
    """Compare standard errors with distances to the truth over samples of equal area.

    Returns:
        ``None`` if fewer than ten samples have a finite expected error above 0.
    """
    valid = expected.isfinite() & (expected > 0)
    expected, true = expected[valid].double().cpu(), true[valid].double().cpu()
    if len(expected) < 10:
        return None
    fraction = true / expected
    order = expected.argsort()
    varied = bool(expected.min() < expected.max())
    correlation = spearmanr(expected.numpy(), true.numpy()).statistic if varied else math.nan
    return Calibration(
        ratio=float(fraction.median()) / 0.6745,
        within_one=float((fraction <= 1).double().mean()),
        within_two=float((fraction <= 2).double().mean()),
        rank_correlation=float(correlation),
        bins=tuple(
            CalibrationBin(
                expected=float(expected[tenth].square().mean().sqrt()),
                root_mean_square=float(true[tenth].square().mean().sqrt()),
                robust=float(true[tenth].median()) / 0.6745,
            )
            for tenth in torch.tensor_split(order, 10)
        ),
        samples=len(expected),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class DistanceFigures(Record):
    """Distances from samples of one surface to the other, scene units.

    Attributes:
        mean_percent: Of the diagonal of the true object's bounding box.
    """

    mean: float
    median: float
    mean_percent: float
    median_percent: float
    samples: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ThresholdFigures(Record):
    """Fractions of each surface within a threshold of the other.

    Attributes:
        f_score: Harmonic mean of precision and recall; 0 if both are 0.
    """

    threshold: float
    threshold_percent: float
    precision: float
    recall: float
    f_score: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TwoSided(Record):
    """Figures of both directions, over the complete truth or a part of it.

    Attributes:
        completeness: From the truth to the estimate.
        chamfer_mean: Mean of mean accuracy and mean completeness, scene units.
        chamfer_sum: Their sum, which some papers call Chamfer distance.
    """

    completeness: DistanceFigures
    chamfer_mean: float
    chamfer_sum: float
    chamfer_mean_percent: float
    chamfer_sum_percent: float
    thresholds: tuple[ThresholdFigures, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceComparison(Record):
    """Distances between a surface and the true one.

    Attributes:
        diagonal: Of the true object's bounding box along the axes of the truth, scene units.
        accuracy: From the estimate to the truth; ``None`` if all of it belongs to the
            surroundings.
        surroundings_fraction: Fraction of the estimate that is nearer to the truth's
            surroundings than to the object, and is excluded from the accuracy.
        seen: Over the part of the truth visible from at least ``seen_from`` camera positions.
        calibration: Of the estimate's expected error, over the samples of the accuracy.
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
    """The true surface, prepared for comparison with any number of estimates.

    Samples are uniform over each surface, and each is compared with the nearest point
    of the other surface, not with its samples or vertices.

    Args:
        capture: With the true mesh or points, and its cameras.
        seen_from: Camera positions that must see a true point, at least; see :func:`count_seeing`.
    """

    def __init__(
        self, capture: Capture, *, seen_from: int = 3, samples: int = 200_000, seed: int = 0
    ) -> None:
        truth, surroundings = true_surface(capture), capture.truth.surroundings
        self.diagonal = bounding_diagonal(truth)
        self._generator = torch.Generator().manual_seed(seed)
        samples_true = sample_surface(truth, samples, self._generator)
        count = count_seeing(samples_true, capture, self.diagonal)
        self._points, self._samples = samples_true.points, samples
        self._state = self._generator.get_state()
        self._seen, self._seen_from = None if count is None else count >= seen_from, seen_from
        self._object = NearestSurface(truth)
        self._surroundings = None
        if surroundings is not None and len(surroundings.vertices_world):
            self._surroundings = NearestSurface(surroundings)

    def compare(
        self, mesh: Mesh, thresholds_percent: Sequence[float] = (0.25, 0.5, 1.0)
    ) -> SurfaceComparison:
        """Measure the distances between an estimate, in the frame of the truth, and the truth.

        Args:
            thresholds_percent: Of the diagonal, for precision, recall and F-score.
        """
        self._generator.set_state(self._state)  # independent of the order of estimates
        drawn = sample_surface(mesh, self._samples, self._generator)
        ours = drawn.points
        to_truth = self._object.query(ours).distance
        off_object = torch.zeros(len(ours), dtype=torch.bool)
        if self._surroundings is not None:
            off_object = self._surroundings.query(ours).distance < to_truth
        to_truth = to_truth[~off_object]
        calibration = None
        if mesh.expected_error is not None:
            calibration = calibrate(drawn.interpolate(mesh.expected_error)[~off_object], to_truth)
        to_estimate = NearestSurface(mesh).query(self._points).distance

        def two_sided(distances: Float[Tensor, " sample"]) -> TwoSided | None:
            if len(distances) == 0 or len(to_truth) == 0:
                return None
            return _two_sided(to_truth, distances, self.diagonal, thresholds_percent)

        seen = self._seen
        return SurfaceComparison(
            diagonal=self.diagonal,
            accuracy=_figures(to_truth, self.diagonal) if len(to_truth) else None,
            surroundings_fraction=float(off_object.double().mean()),
            whole=two_sided(to_estimate),
            seen=None if seen is None else two_sided(to_estimate[seen]),
            seen_from=self._seen_from,
            seen_fraction=None if seen is None else float(seen.double().mean()),
            calibration=calibration,
        )


def with_surroundings(surface: Mesh, truth: Truth) -> Mesh:
    """Append the true surroundings, if known, to the faces of a surface."""
    return join(surface, *([] if truth.surroundings is None else [truth.surroundings]))


def true_surface(capture: Capture) -> Mesh:
    """Return the true mesh of the object, or its points as a mesh without faces."""
    truth = capture.truth
    if truth.mesh is not None:
        return truth.mesh
    if truth.points_world is not None:
        return Mesh(vertices_world=truth.points_world, faces=torch.zeros(0, 3, dtype=torch.long))
    raise InputError("the truth has neither a mesh nor points, so no distance can be measured.")


def bounding_diagonal(mesh: Mesh) -> float:
    """Return the diagonal of the axis-aligned bounding box of a mesh's faces, or of a cloud."""
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
    total = precision + recall
    return ThresholdFigures(
        threshold=threshold,
        threshold_percent=percent,
        precision=precision,
        recall=recall,
        f_score=2 * precision * recall / total if total > 0 else 0.0,
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
