"""Compare settings of structure from motion on folders of photographs.

Run as ``python benchmarks/studies/sfm.py PHOTOS [PHOTOS ...]``; prints Markdown tables, each
followed by the warnings of the runs. ``--reference MODEL`` is a COLMAP model with the same image
names, or a folder with LLFF's ``poses_bounds.npy``: each view's rotation is compared with it, and a
view more than 2 degrees off is wrong. With ``--truth FOLDER``, as ``pimper render`` writes it,
focal lengths and the positions of the object's points are compared with exact rays, after the
similarity on cameras and after the best. Several ``--seeds`` give a row each, because matches and
models are random. With ``--threads 1`` a seed gives the same figures again.
"""

import argparse
import dataclasses
import resource
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from pimper_bench.datasets import read_llff, read_rendered
from pimper_bench.metrics.evaluation import camera_figures
from pimper_bench.table.measure import peak_memory
from pimper_bench.truth import Capture
from pimper_torch.io.cameras.model_files import read_model
from pimper_torch.io.photographs import load_views
from pimper_torch.records import Estimate, Mesh, SparseScene, Views
from pimper_torch.runtime.errors import PimperError, PimperWarning
from pimper_torch.stages.sfm.reconstruct import Reconstruct
from pimper_torch.stages.sfm.reconstruct_config import ReconstructConfig

COLMAP = ReconstructConfig(
    peak_threshold=0.0067,
    affine_shape=False,
    guided_pairs=0,
    max_error_px=4.0,
    starts=0,
    track_iterations=0,
)


# Pairs a photograph: more than there are.
ALL = 10_000

COLUMNS = (
    "settings",
    "views",
    "points",
    "in 3 or more",
    "mean track",
    "error px",
    "wrong views",
    "median rotation error °",
    "focal %",
    "places %",
    "bend %",
    "wall s",
    "CPU s",
    "peak MB",
)


def variants() -> dict[str, ReconstructConfig]:
    """Name the settings to compare: COLMAP's own with one change, and ours with one change."""
    change = dataclasses.replace
    ours = ReconstructConfig()
    first = change(ours, guided_pairs=0, starts=0, track_iterations=0)
    guided = change(ours, starts=0, track_iterations=0)
    return {
        "COLMAP's": COLMAP,
        "COLMAP's, contrast 0.002": change(COLMAP, peak_threshold=0.002),
        "COLMAP's, affine": change(COLMAP, affine_shape=True),
        "COLMAP's, all pairs guided": change(COLMAP, guided_pairs=ALL),
        "COLMAP's, second pass": change(COLMAP, starts=ours.starts),
        "0.002, affine, 2 px": first,
        "the same, 2048 features": change(first, max_features=2048),
        "the same, 8192 features": change(first, max_features=8192),
        "the same, 3 pairs guided": change(first, guided_pairs=3),
        "the same, 10 pairs guided": guided,
        "the same, all pairs guided": change(first, guided_pairs=ALL),
        "ours: tracks found again": ours,
        "ours, no pair guided": change(ours, guided_pairs=0),
        "ours, edge 20": change(guided, edge_threshold=20.0),
        "ours, ratio 0.9": change(guided, max_ratio=0.9),
    }


def main() -> None:
    """Read the command line, run every variant on every folder, print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("photos", nargs="+", type=Path, help="folders of photographs")
    parser.add_argument("--reference", type=Path, help="COLMAP model to compare poses with")
    parser.add_argument("--truth", type=Path, help="folder of a rendered scene to compare with")
    parser.add_argument("--masks", type=Path, help="folder of masks, white on the object")
    parser.add_argument("--max-size", type=int, default=0, help="longest side in pixels")
    parser.add_argument("--only", nargs="*", default=[], help="parts of the variants' names")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="one row each")
    parser.add_argument("--threads", type=int, default=0, help="0 for all cores")
    options = parser.parse_args()
    truth = None
    if options.truth is not None:
        truth = read_rendered(options.truth, maps=False, photographs=False)
    for folder in options.photos:
        views = load_views(folder, max_size_px=options.max_size, masks=options.masks)
        width, height = views.sizes_px.amax(dim=0).tolist()
        say(f"\n{folder.name}: {views.num_views} photographs, {width}x{height}\n")
        say("| " + " | ".join(COLUMNS) + " |")
        say("|---|" + "--:|" * (len(COLUMNS) - 1))
        told = []
        for name, config in chosen(options.only, options.seeds).items():
            config = dataclasses.replace(config, threads=options.threads)
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", PimperWarning)
                say(f"| {name} | {row(views, config, options.reference, truth)} |")
            told += [f"{name}: {warning.message}" for warning in caught]
        say("".join(f"\n{line}\n" for line in told))


def chosen(only: Sequence[str], seeds: Sequence[int]) -> dict[str, ReconstructConfig]:
    """Take the settings whose names hold one of some parts, or all, once a seed."""
    return {
        name if len(seeds) == 1 else f"{name}, seed {seed}": dataclasses.replace(config, seed=seed)
        for name, config in variants().items()
        if not only or any(part in name for part in only)
        for seed in seeds
    }


def say(line: str) -> None:
    """Write a line of the table at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def row(
    views: Views, config: ReconstructConfig, reference: Path | None, truth: Capture | None
) -> str:
    """Run structure from motion once and give its figures as cells."""
    wall, processor = time.perf_counter(), cpu_seconds()
    with peak_memory() as peak:
        try:
            found: SparseScene | PimperError = Reconstruct(config)(views)
        except PimperError as error:
            found = error
        wall, processor = time.perf_counter() - wall, cpu_seconds() - processor
        megabytes = peak() or float("nan")
    if isinstance(found, PimperError):
        cells = [f"{type(found).__name__}: {str(found).split('.')[0]}", *[""] * 9]
    else:
        cells = figures(found, reference, truth)
    return " | ".join([*cells, f"{wall:.0f}", f"{processor:.0f}", f"{megabytes:.0f}"])


def figures(scene: SparseScene, reference: Path | None, truth: Capture | None) -> list[str]:
    """Count the results, and compare cameras with the reference and the truth if given."""
    length = torch.bincount(scene.observation_point)
    wrong, median = "", ""
    if reference is not None:
        angles = rotation_errors_deg(scene, reference)
        wrong, median = str(int((angles > 2).sum())), f"{angles.median():.2f}"
    against = ["", "", ""]
    if truth is not None:
        found = camera_figures(estimate_of(scene), truth)
        if found is not None:
            against = [
                f"{found.mean_focal_percent:.2f}",
                f"{found.mean_position_percent:.3f}",
                f"{found.mean_bend_percent:.4f}",
            ]
    return [
        f"{scene.views.num_views} of {scene.views.num_views + len(scene.unregistered)}",
        str(len(length)),
        str(int((length >= 3).sum())),
        f"{length.double().mean():.2f}",
        f"{scene.reprojection_errors_px.mean():.2f}",
        wrong,
        median,
        *against,
    ]


def estimate_of(scene: SparseScene) -> Estimate:
    """Take the cloud for the surface: nothing but cameras is compared."""
    cloud = Mesh(
        vertices_world=scene.points_world.double(), faces=torch.zeros(0, 3, dtype=torch.long)
    )
    return Estimate(mesh=cloud, names=scene.views.names, cameras=scene.cameras)


def rotation_errors_deg(scene: SparseScene, reference: Path) -> Tensor:
    """Return the angle between each view's rotation and the reference's, after alignment."""
    names, cam_from_world = reference_poses(reference)
    number = {name: index for index, name in enumerate(names)}
    shared = [index for index, name in enumerate(scene.views.names) if name in number]
    theirs = cam_from_world[[number[scene.views.names[index]] for index in shared]].double()
    mine = scene.cameras.cam_from_world[shared].double()
    # The rotation between the worlds that most views agree on: of all the views' own, the one
    # with the least median angle to the others.
    between = theirs[:, :3, :3].mT @ mine[:, :3, :3]
    trace = torch.einsum("aij,bij->ab", between, between)
    angles = torch.rad2deg(((trace - 1) / 2).clamp(-1, 1).arccos())
    return angles[angles.median(dim=1).values.argmin()]


def reference_poses(folder: Path) -> tuple[tuple[str, ...], Tensor]:
    """Read names and ``cam_from_world`` of an LLFF set or a COLMAP model."""
    if (folder / "poses_bounds.npy").is_file():
        capture = read_llff(folder, max_size_px=64)  # the poses alone are wanted
        return capture.views.names, capture.cameras.cam_from_world
    model = read_model(folder)
    return model.names, model.cam_from_world


def cpu_seconds() -> float:
    """Return the processor time this process has used, all threads together."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


if __name__ == "__main__":
    main()
