"""Reports of a run's stages: time, memory, and the figures of each record."""

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
    """Whoever wants to show how a run is going."""

    def started(self, stage: str) -> None:
        """Hear that a stage begins."""

    def progressed(self, done: int, total: int) -> None:
        """Hear that the stage has done some of its batches."""

    def finished(self, report: StageReport) -> None:
        """Hear that a stage ended, what it cost and what it found."""


class Silent:
    """An observer that shows nothing."""

    def _hear(self, *_: object, **__: object) -> None:
        pass

    started = progressed = finished = _hear


# What neither stages nor other lines of a run's table do.
BETWEEN = "between stages"
ASIDE = HASH, KEEP, BETWEEN


def reported(
    name: str, seconds: float, figures: dict[str, int | float] | None = None
) -> StageReport:
    """Return the report of what has just ended."""
    return StageReport(
        name=name, seconds=seconds, peak_memory_mb=peak_memory_mb(), figures=figures or {}
    )


def seconds_of(reports: Iterable[StageReport]) -> float:
    """Add up what stages took in this run; those of kept records took their time in another."""
    return sum(report.seconds for report in reports if not report.kept)


def gathered(reports: Sequence[StageReport]) -> tuple[StageReport, ...]:
    """Put the lines of what no stage did at the end, each once."""
    parts = {name: [one for one in reports if one.name == name] for name in ASIDE}
    lines = [some[-1].replace(seconds=seconds_of(some)) for some in parts.values() if some]
    return (*(one for one in reports if one.name not in ASIDE), *lines)


@contextmanager
def recorded(observer: Observer) -> Iterator[list[StageReport]]:
    """Report the stages of the ``with`` block; see :func:`stage`.

    A block inside another one that is in no stage is part of it.

    Yields:
        The list that holds the reports when the block has ended, and one of each line of what no
        stage did.
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
    own = _reports(events[before:])
    reports += _lines(journal, own)
    events += reports[len(own) :]


def accounted() -> tuple[StageReport, ...]:
    """Return all lines of the call so far, which make up its seconds."""
    journal = current()
    return () if journal.observer is None else gathered(_lines(journal, journal.so_far()))


def _reports(events: Iterable[object]) -> list[StageReport]:
    return [event for event in events if isinstance(event, StageReport)]


def _lines(journal: Journal, events: Iterable[object]) -> list[StageReport]:
    """Return the reports, and lines of what no stage did: they make up the call's seconds."""
    lines = [*_reports(events), *(reported(name, took) for name, took in journal.aside.items())]
    rest = time.perf_counter() - journal.began - seconds_of(lines)
    return [*lines, reported(BETWEEN, rest)]


@contextmanager
def stage(name: str) -> Iterator[dict[str, int | float]]:
    """Report what the ``with`` block does as one stage, and nothing of the stages it calls.

    Yields:
        The figures to be told, empty at first.
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
    events[before:] = [one for one in events[before:] if not isinstance(one, StageReport)]
    events.append(report)
    journal.observer.finished(report)


@contextmanager
def part(name: str) -> Iterator[None]:
    """Add the seconds of the ``with`` block, in whichever thread, to the figures of its stage."""
    began = time.perf_counter()
    yield
    add_counts({f"{name}_seconds": time.perf_counter() - began})


def add_counts(counts: Mapping[str, int | float]) -> None:
    """Add counts to the figures of the stage that runs, from any of its threads."""
    metrics = current().figures
    with _counting:
        for name, count in counts.items():
            metrics[name] = metrics.get(name, 0) + count


def called(name: str, call: Callable[..., R], *inputs: object) -> R:
    """Call a stage, and report it with the figures of its record."""
    with stage(name) as metrics:
        record = call(*inputs)
        metrics |= figures(record)
    return record


def peak_memory_mb() -> float:
    """Return highest resident memory of this process so far; 0 where the system does not tell."""
    if sys.platform == "win32":
        return 0.0
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)  # bytes there, kilobytes here


@singledispatch
def figures(record: object) -> dict[str, int | float]:
    """Return the counts and fractions of a record that are worth telling."""
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
def _(found: SilhouetteCoverage) -> dict[str, int | float]:
    if not len(found.uncovered):
        return {}
    return {
        "covered": 1 - float(found.uncovered.mean()),
        "sticking_out": float(found.outside.mean()),
        "least_covered": 1 - float(found.uncovered.max()),
        "most_sticking_out": float(found.outside.max()),
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
def _(seen: PatchViews) -> dict[str, int | float]:
    pairs = list(zip(seen.patches.buckets, seen.buckets, strict=True))
    samples = sum(int(bucket.inside.sum()) * views.valid.shape[1] for bucket, views in pairs)
    valid = sum(int(views.valid.count_nonzero()) for _, views in pairs)
    return {"samples": samples, "missing_samples": samples - valid}


@figures.register
def _(photometric: PhotometricPatches) -> dict[str, int | float]:
    pairs = list(zip(photometric.patches.buckets, photometric.buckets, strict=True))
    inside = sum(int(templates.inside.sum()) for templates, _ in pairs)
    count = photometric.patches.num_patches
    ended = [bucket.convergence for _, bucket in pairs]
    statuses = Counter(code for _, bucket in pairs for code in bucket.status.tolist())
    return {
        "valid_fraction": sum(int(bucket.valid.sum()) for _, bucket in pairs) / inside,
        **{f"{status.name.lower()}_patches": statuses[status] for status in PatchStatus},
        "converged_patches": sum(int(end.converged.sum()) for end in ended),
        "mean_iterations": sum(float(end.iterations.sum()) for end in ended) / count,
        "mean_residual": sum(float(end.residual.detach().sum()) for end in ended) / count,
    }


@figures.register
def _(swept: SweptPatches) -> dict[str, int | float]:
    """Return how far priors are from what photographs tell, over what both claim; 1 is right."""
    angles, normals, depths = [], [], []
    for light, height in zip(swept.photometric.buckets, swept.buckets, strict=True):
        if (guess := height.priors) is not None:
            both = light.valid & (guess.normal_information > 0)
            square = (guess.normals_patch - light.normals_patch)[both].square().sum(dim=-1)
            claim = 1 / guess.normal_information[both] + 1 / light.information[both]
            angles.append(square.detach())
            normals.append((square / claim).detach())
            both = (height.information > 0) & (guess.offset_information > 0)
            square = (guess.offset - height.offset)[both].square()
            claim = 1 / guess.offset_information[both] + 1 / height.information[both]
            depths.append((square / claim).detach())
    metrics: dict[str, int | float] = {}
    if sum(map(len, normals)):
        # Medians of squares of Gaussian noise in two components, and in one.
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
