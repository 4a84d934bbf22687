"""One method on one rendered scene, with every figure that tables show."""

import resource
from pathlib import Path
from typing import Any

from declared import Figures, Place

from pimper_bench.metrics.evaluation import Evaluation, evaluate
from pimper_bench.metrics.similarity import transfer
from pimper_bench.table.bench_inputs import BenchConfig, Inputs, method_named, prepare
from pimper_bench.table.measure import peak_memory
from pimper_torch.io.meshes import write_ply

SETTINGS = Path(__file__).parents[2] / "configs" / "ablation"


def inputs_of(place: Place, name: str, given: BenchConfig, **scene: Any) -> Inputs:  # noqa: ANN401
    """Return the inputs that all methods share; models of cameras are kept."""
    return prepare(place.scene(name, **scene), given, place.cache / "sfm")


def run(
    place: Place,
    name: str,
    method: str = "default",
    given: BenchConfig | None = None,
    *,
    keep: bool = False,
    **scene: Any,  # noqa: ANN401 - of SceneConfig
) -> Figures:
    """Run a method on a scene, and compare it with the truth.

    Args:
        method: A preset, a baseline, or a file of ``configs/ablation`` without its ending.
        given: Whether masks and cameras are true; neither by default.
        keep: Keep stages for rows with other settings; seconds are then of no use.
    """
    given = given or BenchConfig()
    inputs = inputs_of(place, name, given, **scene)
    file = SETTINGS / f"{method}.yaml"
    stages = place.cache / "stages" if keep else None
    chosen = method_named(str(file) if file.exists() else method, stages)
    began = cpu_seconds()
    with peak_memory() as peak:
        outcome = chosen(inputs.scene, inputs.coarse)
        memory = peak()
    seconds = cpu_seconds() - began
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**10
    found = evaluate(
        outcome.estimate, inputs.capture, given.evaluation, surface=inputs.surface, maps=inputs.maps
    )
    mesh = transfer(outcome.estimate.mesh, found.alignment.truth_from_world)
    write_ply(mesh, mesh_of(place, name, method, **scene))
    views = inputs.scene.views.num_views
    cost = {"CPU s": seconds, "GB": max(memory or 0.0, children * outcome.external) / 2**10}
    return {"registered": views} | figures_of(found) | cost


def mesh_of(place: Place, name: str, method: str, **scene: Any) -> Path:  # noqa: ANN401
    """Return the file of a surface that :func:`run` found, in the frame of the truth."""
    folder = place.cache / "meshes"
    folder.mkdir(parents=True, exist_ok=True)
    return folder / f"{place.scene(name, **scene).name}-{method}.ply"


def figures_of(found: Evaluation) -> Figures:
    """Flatten an evaluation: per cent of the diagonal, degrees, and per cent."""
    figures: Figures = {}
    for view in found.views[:1]:
        figures |= {"covered": 100 * view.coverage, "3D error": view.relative_error}
        if view.shape_normals:
            shape = view.shape_normals
            figures |= {"normals": shape.mean_deg, "normals, median": shape.median_deg}
        if view.albedo:
            albedo = view.albedo
            figures |= {"albedo": albedo.one_scale_percent}
            figures |= {"albedo, median": albedo.one_scale_median_percent}
    if found.surface and found.surface.accuracy and found.surface.seen:
        surface, percent = found.surface, 100 / found.surface.diagonal
        accuracy, seen = found.surface.accuracy, found.surface.seen
        figures |= {
            "accuracy": percent * accuracy.mean,
            "accuracy, median": percent * accuracy.median,
        }
        figures |= {"completeness": percent * seen.completeness.mean}
        figures |= {"Chamfer": seen.chamfer_mean_percent}
        if surface.calibration:
            figures |= calibration_of(surface.calibration, percent)
    if found.lights:
        figures["lights"] = found.lights.mean_rotated_deg
    if found.cameras:
        cameras = found.cameras
        figures |= {"places": cameras.mean_position_percent, "bend": cameras.mean_bend_percent}
        figures |= {"focal": cameras.mean_focal_percent, "centres": cameras.mean_center_percent}
        figures["rotation"] = cameras.median_rotation_deg
    return figures


def calibration_of(found: Any, percent: float) -> Figures:  # noqa: ANN401
    """Return what expected errors are worth, with three of their tenths."""
    told = {"ratio": found.ratio, "rank": found.rank_correlation}
    told |= {"within one": 100 * found.within_one, "within two": 100 * found.within_two}
    for name, tenth in (("first", 0), ("fifth", 4), ("last", -1)):
        each = found.bins[tenth]
        told[f"{name} expected"] = percent * each.expected
        told[f"{name} true"] = percent * each.root_mean_square
    return told


def cpu_seconds() -> float:
    """Return the processor time of this process and of its ended children."""
    each = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in each)
