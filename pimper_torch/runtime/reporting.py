"""Stage reports: time, memory, and figures of the returned record."""

import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import singledispatch
from threading import Lock
from typing import Protocol, TypeVar, runtime_checkable

import torch
from torch import Tensor

from pimper_torch.ground.geometry.contours import Contours
from pimper_torch.ground.geometry.topology import boundary_loops
from pimper_torch.records import (
    CoarseMesh,
    DepthPatches,
    Mesh,
    OrientedPoints,
    PatchSet,
    PatchStatus,
    PatchViews,
    PhotometricPatches,
    SilhouetteCoverage,
    Silhouettes,
    SparseScene,
    StageReport,
    Surface,
    SweptPatches,
)
from pimper_torch.runtime.journal import HASH, KEEP, Journal, current, writing

R = TypeVar("R")

_counting = Lock()


@runtime_checkable
class Observer(Protocol):
    """Receiver of the progress of a run, for display."""

    def started(self, stage: str) -> None:
        """Receive the name of a stage that starts."""

    def progressed(self, done: int, total: int) -> None:
        """Receive the number of finished batches of the stage."""

    def finished(self, report: StageReport) -> None:
        """Receive the report of a finished stage: its cost and figures."""


class SilentObserver:
    """Observer that ignores everything."""

    def _hear(self, *_: object, **__: object) -> None:
        pass

    started = progressed = finished = _hear


# Line of a run's table for the time outside of stages and of its other lines.
BETWEEN = "between stages"
ASIDE = HASH, KEEP, BETWEEN


def reported(
    name: str, seconds: float, figures: dict[str, int | float] | None = None
) -> StageReport:
    """Return the report of a stage or line that has just ended."""
    return StageReport(
        name=name, seconds=seconds, peak_memory_mb=peak_memory_mb(), figures=figures or {}
    )


def seconds_of(reports: Iterable[StageReport]) -> float:
    """Return the seconds of all stages in this run; stages with kept records ran earlier."""
    return sum(report.seconds for report in reports if not report.kept)


def gathered(reports: Sequence[StageReport]) -> tuple[StageReport, ...]:
    """Return the reports with the lines outside of stages added up, at the end."""
    groups = [[report for report in reports if report.name == name] for name in ASIDE]
    lines = [group[-1].replace(seconds=seconds_of(group)) for group in groups if group]
    return (*(report for report in reports if report.name not in ASIDE), *lines)


@contextmanager
def recorded(observer: Observer) -> Iterator[list[StageReport]]:
    """Collect the reports of the stages in the ``with`` block; see :func:`stage`.

    A nested block outside of a stage is part of the outer block.

    Yields:
        A list, filled at the end of the block with the reports, and those of lines outside stages.
    """
    events, reports = current().so_far(), list[StageReport]()
    before = len(events)
    journal = replace(
        current(),
        events=events,
        observer=observer,
        progress=observer.progressed,
        began=time.perf_counter(),
        aside={},
    )
    with writing(journal):
        yield reports
    stages = _reports(events[before:])
    reports += _lines(journal, stages)
    events += reports[len(stages) :]


def accounted() -> tuple[StageReport, ...]:
    """Return all lines of the call so far; their seconds add up to those of the call."""
    journal = current()
    return () if journal.observer is None else gathered(_lines(journal, journal.so_far()))


def _reports(events: Iterable[object]) -> list[StageReport]:
    return [event for event in events if isinstance(event, StageReport)]


def _lines(journal: Journal, events: Iterable[object]) -> list[StageReport]:
    """Return the reports and the lines outside of stages; they add up to the call's seconds."""
    lines = [*_reports(events), *(reported(name, time) for name, time in journal.aside.items())]
    rest = time.perf_counter() - journal.began - seconds_of(lines)
    return [*lines, reported(BETWEEN, rest)]


@contextmanager
def stage(name: str) -> Iterator[dict[str, int | float]]:
    """Report the ``with`` block as one stage; stages that it calls are not reported.

    Yields:
        The figures of the report, for the caller to fill.
    """
    metrics: dict[str, int | float] = {}
    journal, began = current(), time.perf_counter()
    if journal.observer is None:
        yield metrics
        return
    events = journal.so_far()
    before = len(events)
    journal.observer.started(name)
    with writing(replace(journal, observer=None, figures=metrics)):
        yield metrics
    report = reported(name, time.perf_counter() - began, metrics)
    events[before:] = [event for event in events[before:] if not isinstance(event, StageReport)]
    events.append(report)
    journal.observer.finished(report)


@contextmanager
def part(name: str) -> Iterator[None]:
    """Add the seconds of the ``with`` block to the figures of its stage, from any thread."""
    began = time.perf_counter()
    yield
    add_counts({f"{name}_seconds": time.perf_counter() - began})


def add_counts(counts: Mapping[str, int | float]) -> None:
    """Add counts to the figures of the running stage, from any thread."""
    metrics = current().figures
    with _counting:
        for name, count in counts.items():
            metrics[name] = metrics.get(name, 0) + count


def called(name: str, call: Callable[..., R], *inputs: object) -> R:
    """Return the record of a stage, and report the call with the record's figures."""
    with stage(name) as metrics:
        record = call(*inputs)
        metrics |= figures(record)
    return record


def peak_memory_mb() -> float:
    """Return the peak resident memory of this process so far, in MB; 0 on Windows."""
    if sys.platform == "win32":
        return 0.0
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)  # bytes there, kilobytes here


@singledispatch
def figures(record: object) -> dict[str, int | float]:
    """Return counts and fractions that characterize a record, for its report."""
    return {}


@figures.register
def _(scene: SparseScene) -> dict[str, int | float]:
    return {
        "views": scene.views.num_views + len(scene.unregistered),
        "registered": scene.views.num_views,
        "sparse_points": len(scene.points_world),
        "mean_track_length": len(scene.observation_point) / max(1, len(scene.points_world)),
        "mean_reprojection_px": _mean(scene.reprojection_errors_px),
        "doubtful": int(bool(scene.diagnosis)),
    }


@figures.register
def _(silhouettes: Silhouettes) -> dict[str, int | float]:
    masks = silhouettes.masks
    return {
        "reliable_views": int(silhouettes.reliable.sum()),
        "object_fraction": int(masks.count_nonzero()) / max(1, masks.numel()),
    }


@figures.register
def _(coverage: SilhouetteCoverage) -> dict[str, int | float]:
    if not len(coverage.uncovered):
        return {}
    return {
        "covered": 1 - float(coverage.uncovered.mean()),
        "sticking_out": float(coverage.outside.mean()),
        "least_covered": 1 - float(coverage.uncovered.max()),
        "most_sticking_out": float(coverage.outside.max()),
    }


@figures.register
def _(contours: Contours) -> dict[str, int | float]:
    return {"contour_rays": len(contours.rays.view)}


@figures.register
def _(cloud: OrientedPoints) -> dict[str, int | float]:
    return {"points": len(cloud.points_world)}


@figures.register
def _(coarse: CoarseMesh) -> dict[str, int | float]:
    return {
        "mesh_points": len(coarse.mesh.vertices_world),
        "filled_points": int((~coarse.is_point).sum()),
        "triangles": len(coarse.mesh.faces),
    }


@figures.register
def _(patches: PatchSet) -> dict[str, int | float]:
    return {
        "patches": patches.num_patches,
        "template_samples": sum(int(bucket.inside.sum()) for bucket in patches.buckets),
    }


@figures.register
def _(observed: PatchViews) -> dict[str, int | float]:
    pairs = list(zip(observed.patches.buckets, observed.buckets, strict=True))
    samples = sum(int(bucket.inside.sum()) * views.valid.shape[1] for bucket, views in pairs)
    valid = sum(int(views.valid.count_nonzero()) for _, views in pairs)
    return {"samples": samples, "missing_samples": samples - valid}


@figures.register
def _(photometric: PhotometricPatches) -> dict[str, int | float]:
    pairs = list(zip(photometric.patches.buckets, photometric.buckets, strict=True))
    inside = sum(int(templates.inside.sum()) for templates, _ in pairs)
    count = photometric.patches.num_patches
    convergence = [bucket.convergence for _, bucket in pairs]
    statuses = Counter(code for _, bucket in pairs for code in bucket.status.tolist())
    return {
        "valid_fraction": sum(int(bucket.valid.sum()) for _, bucket in pairs) / inside,
        **{f"{status.name.lower()}_patches": statuses[status] for status in PatchStatus},
        "converged_patches": sum(int(state.converged.sum()) for state in convergence),
        "mean_iterations": sum(float(state.iterations.sum()) for state in convergence) / count,
        "mean_residual": sum(float(state.residual.detach().sum()) for state in convergence) / count,
    }


@figures.register
def _(swept: SweptPatches) -> dict[str, int | float]:
    """Return the median deviation of priors over its stated error; 1 if variances are right."""
    angles, normals, depths = [], [], []
    for light, height in zip(swept.photometric.buckets, swept.buckets, strict=True):
        if (prior := height.priors) is not None:
            known = light.valid & (prior.normal_information > 0)
            square = (prior.normals_patch - light.normals_patch)[known].square().sum(dim=-1)
            variance = 1 / prior.normal_information[known] + 1 / light.information[known]
            angles.append(square.detach())
            normals.append((square / variance).detach())
            known = (height.information > 0) & (prior.offset_information > 0)
            square = (prior.offset - height.offset)[known].square()
            variance = 1 / prior.offset_information[known] + 1 / height.information[known]
            depths.append((square / variance).detach())
    metrics: dict[str, int | float] = {}
    if sum(map(len, normals)):
        # Medians of squared Gaussian noise over their mean: log(2) in 2D, 0.4549 in 1D.
        metrics["prior_normals_deg"] = math.degrees(float(torch.cat(angles).median()) ** 0.5)
        metrics["prior_normals_over_claim"] = (
            float(torch.cat(normals).median() / math.log(2)) ** 0.5
        )
    if sum(map(len, depths)):
        metrics["prior_depths_over_claim"] = float(torch.cat(depths).median() / 0.4549) ** 0.5
    return metrics


@figures.register
def _(depths: DepthPatches) -> dict[str, int | float]:
    metrics: dict[str, int | float] = {
        "valid_depths": sum(int(bucket.valid.sum()) for bucket in depths.buckets)
    }
    if all(bucket.status is not None for bucket in depths.buckets):
        metrics["aligned_patches"] = sum(int(bucket.aligned.sum()) for bucket in depths.buckets)
    if depths.mismatch is not None:
        metrics["mismatch_before"] = float(depths.mismatch[0])
        metrics["mismatch"] = float(depths.mismatch[-1])
    return metrics


@figures.register
def _(surface: Surface) -> dict[str, int | float]:
    return {
        "subdivision_points": len(surface.vertices_world),
        "supported_fraction": _mean(surface.supported.float()),
        "relative_residual": _mean(surface.convergence.residual),
    }


@figures.register
def _(mesh: Mesh) -> dict[str, int | float]:
    _, loop = boundary_loops(mesh.faces)
    return {
        "vertices": len(mesh.vertices_world),
        "faces": len(mesh.faces),
        "openings": int(loop.max()) + 1 if len(loop) else 0,
    }


def _mean(values: Tensor) -> float:
    return float(values.mean()) if len(values) else 0.0
