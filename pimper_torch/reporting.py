"""What a run tells about its stages: time, memory, and the figures of each record."""

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import singledispatch
from typing import Protocol, runtime_checkable

from torch import Tensor, nn

from pimper_torch.geometry.topology import boundary_loops
from pimper_torch.patches.warp import missing_fraction
from pimper_torch.progress import listening
from pimper_torch.records import (
    CoarseMesh,
    DepthPatches,
    Mesh,
    PatchSet,
    PatchViews,
    PhotometricPatches,
    Silhouettes,
    SparseScene,
    StageReport,
    Surface,
)
from pimper_torch.silhouettes.contours import Contours


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

    def started(self, stage: str) -> None:
        """Do nothing."""

    def progressed(self, done: int, total: int) -> None:
        """Do nothing."""

    def finished(self, report: StageReport) -> None:
        """Do nothing."""


@dataclass(frozen=True, slots=True)
class _Recording:
    """The reports of a call, and who hears of them."""

    reports: list[StageReport]
    observer: Observer

    def finish(self, name: str, began: float, told: dict[str, int | float]) -> None:
        """Report that a stage ended."""
        report = StageReport(
            name=name,
            seconds=time.perf_counter() - began,
            peak_memory_mb=peak_memory_mb(),
            figures=told,
        )
        self.reports.append(report)
        self.observer.finished(report)


# Of the call that this thread is in. Hooks belong to a module, which threads share.
_recording: ContextVar[_Recording | None] = ContextVar("recording", default=None)


@contextmanager
def recorded(chain: nn.Module, observer: Observer) -> Iterator[list[StageReport]]:
    """Time the direct submodules of ``chain`` while the ``with`` block calls them.

    Threads that share ``chain`` have reports of their own.

    Yields:
        The list that a report is appended to whenever a submodule has run.
    """
    recording = _Recording([], observer)
    began: dict[str, float] = {}
    hooks = []
    for name, module in chain.named_children():

        def before(_: nn.Module, __: tuple[object, ...], name: str = name) -> None:
            if _recording.get() is recording:
                began[name] = time.perf_counter()
                observer.started(name)

        def after(_: nn.Module, __: tuple[object, ...], output: object, name: str = name) -> None:
            if _recording.get() is recording:
                recording.finish(name, began[name], figures(output))

        hooks += [module.register_forward_pre_hook(before), module.register_forward_hook(after)]
    token = _recording.set(recording)
    try:
        with listening(observer.progressed):
            yield recording.reports
    finally:
        _recording.reset(token)
        for hook in hooks:
            hook.remove()


@contextmanager
def stage(name: str) -> Iterator[dict[str, int | float]]:
    """Report what the ``with`` block does as one stage, and nothing of the stages it calls.

    Yields:
        The figures to be told, empty at first.
    """
    told: dict[str, int | float] = {}
    recording = _recording.get()
    if recording is None:
        yield told
        return
    began = time.perf_counter()
    recording.observer.started(name)
    token = _recording.set(None)
    try:
        yield told
    finally:
        _recording.reset(token)
    recording.finish(name, began, told)


@contextmanager
def noted() -> Iterator[list[StageReport]]:
    """Note the reports of the stages that run inside the block; they are made all the same.

    Yields:
        The list that holds them when the block has ended.
    """
    recording, reports = _recording.get(), list[StageReport]()
    before = 0 if recording is None else len(recording.reports)
    yield reports
    if recording is not None:
        reports += recording.reports[before:]


def repeat(reports: Sequence[StageReport]) -> None:
    """Report stages again whose records an earlier run found."""
    recording = _recording.get()
    if recording is None:
        return
    for report in reports:
        again = report.replace(kept=True)
        recording.observer.started(again.name)
        recording.reports.append(again)
        recording.observer.finished(again)


def peak_memory_mb() -> float:
    """Give the highest resident memory of this process so far; 0 where the system does not tell."""
    if sys.platform == "win32":
        return 0.0
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)  # bytes there, kilobytes here


@singledispatch
def figures(record: object) -> dict[str, int | float]:
    """Give the counts and fractions of a record that are worth telling."""
    return {}


@figures.register
def _(scene: SparseScene) -> dict[str, int | float]:
    length = len(scene.observation_point) / max(1, len(scene.points_world))
    return {
        "views": scene.views.num_views + len(scene.unregistered),
        "registered": scene.views.num_views,
        "sparse_points": len(scene.points_world),
        "mean_track_length": length,
        "mean_reprojection_px": _mean(scene.reprojection_errors_px),
        "doubtful": int(bool(scene.doubt)),
    }


@figures.register
def _(silhouettes: Silhouettes) -> dict[str, int | float]:
    return {
        "reliable_views": int(silhouettes.reliable.sum()),
        "object_fraction": _mean(silhouettes.masks.flatten().float()),
    }


@figures.register
def _(contours: Contours) -> dict[str, int | float]:
    return {"contour_rays": len(contours.rays.view)}


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
    num_views = seen.buckets[0].valid.shape[1]
    samples = sum(int(bucket.inside.sum()) for bucket in seen.patches.buckets) * num_views
    return {"samples": samples, "missing_fraction": missing_fraction(seen)}


@figures.register
def _(photometric: PhotometricPatches) -> dict[str, int | float]:
    pairs = list(zip(photometric.patches.buckets, photometric.buckets, strict=True))
    inside = sum(int(templates.inside.sum()) for templates, _ in pairs)
    count = photometric.patches.num_patches
    ended = [bucket.convergence for _, bucket in pairs]
    return {
        "valid_fraction": sum(int(bucket.valid.sum()) for _, bucket in pairs) / inside,
        "determined_patches": sum(int(bucket.determined.sum()) for _, bucket in pairs),
        "converged_patches": sum(int(end.converged.sum()) for end in ended),
        "mean_iterations": sum(float(end.iterations.sum()) for end in ended) / count,
        "mean_residual": sum(float(end.residual.detach().sum()) for end in ended) / count,
    }


@figures.register
def _(depths: DepthPatches) -> dict[str, int | float]:
    told: dict[str, int | float] = {
        "valid_depths": sum(int(bucket.valid.sum()) for bucket in depths.buckets)
    }
    if all(bucket.status is not None for bucket in depths.buckets):
        told["aligned_patches"] = sum(int(bucket.aligned.sum()) for bucket in depths.buckets)
    if depths.mismatch is not None:
        told["mismatch_before"] = float(depths.mismatch[0])
        told["mismatch"] = float(depths.mismatch[-1])
    return told


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
