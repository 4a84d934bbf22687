"""Compare settings of structure from motion on folders of photographs.

Run as ``python benchmarks/sfm.py PHOTOS [PHOTOS ...]``; prints Markdown tables. With
``--reference MODEL``, a COLMAP model whose images have the photographs' names, each view's
rotation is compared with the model's; a view more than 2 degrees off counts as wrong. With
``--truth FOLDER``, as ``pimper render`` writes it, focal lengths and the places of the object's
points are compared: where exact rays put them, after the similarity on cameras and after the best.
"""

import argparse
import dataclasses
import resource
import sys
import time
import warnings
from pathlib import Path

import torch
from torch import Tensor

from pimper_torch.datasets import read_rendered
from pimper_torch.errors import PimperError, PimperWarning
from pimper_torch.io.photographs import load_views
from pimper_torch.metrics.evaluate import camera_figures
from pimper_torch.records import Capture, Estimate, Mesh, SparseScene, Views
from pimper_torch.sfm.colmap import read_model
from pimper_torch.sfm.reconstruct import Reconstruct, ReconstructConfig

COLMAP = ReconstructConfig(
    peak_threshold=0.0067,
    affine_shape=False,
    domain_size_pooling=False,
    guided_matching=False,
    max_error_px=4.0,
    min_registration_points=30,
    starts=1,
    track_rounds=0,
)


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
)


def variants() -> dict[str, ReconstructConfig]:
    """Name the settings to compare: one change after another, from COLMAP's own to ours."""
    change = dataclasses.replace
    ours = ReconstructConfig()
    features = change(ours, track_rounds=0)
    return {
        "COLMAP's": COLMAP,
        "contrast 0.002": change(COLMAP, peak_threshold=0.002),
        "contrast 0.001": change(COLMAP, peak_threshold=0.001),
        "guided": change(COLMAP, guided_matching=True),
        "0.002, affine": change(COLMAP, peak_threshold=0.002, affine_shape=True),
        "0.002, DSP": change(COLMAP, peak_threshold=0.002, domain_size_pooling=True),
        "0.002, affine, guided": change(features, max_error_px=4.0, starts=1),
        "0.002, affine, guided, 2 px": change(features, starts=1),
        "the same, at most 3 starts": features,
        "ours: the same, tracks found again": ours,
        "features, edge 20": change(features, edge_threshold=20.0),
        "features, ratio 0.9": change(features, max_ratio=0.9),
        "features, DSP": change(features, domain_size_pooling=True),
        "features, 1 px": change(features, max_error_px=1.0),
    }


def main() -> None:
    """Read the command line, run every variant on every folder, print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("photos", nargs="+", type=Path, help="folders of photographs")
    parser.add_argument("--reference", type=Path, help="COLMAP model to compare poses with")
    parser.add_argument("--truth", type=Path, help="folder of a rendered scene to compare with")
    parser.add_argument("--max-size", type=int, default=0, help="longest side in pixels")
    parser.add_argument("--only", nargs="*", default=[], help="parts of the variants' names")
    options = parser.parse_args()
    warnings.simplefilter("ignore", PimperWarning)
    truth = None
    if options.truth is not None:
        truth = read_rendered(options.truth, maps=False, photographs=False)
    for folder in options.photos:
        views = load_views(folder, max_size_px=options.max_size)
        width, height = views.sizes_px.amax(dim=0).tolist()
        say(f"\n{folder.name}: {views.num_views} photographs, {width}x{height}\n")
        say("| " + " | ".join(COLUMNS) + " |")
        say("|---|" + "--:|" * (len(COLUMNS) - 1))
        for name, config in variants().items():
            if not options.only or any(part in name for part in options.only):
                say(f"| {name} | {row(views, config, options.reference, truth)} |")


def say(line: str) -> None:
    """Write a line of the table at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def row(
    views: Views, config: ReconstructConfig, reference: Path | None, truth: Capture | None
) -> str:
    """Run structure from motion once and give its figures as cells."""
    wall, processor = time.perf_counter(), cpu_seconds()
    try:
        scene = Reconstruct(config)(views)
        cells = figures(scene, reference, truth)
    except PimperError as error:
        cells = [f"{type(error).__name__}: {str(error).split('.')[0]}", *[""] * 9]
    wall, processor = time.perf_counter() - wall, cpu_seconds() - processor
    return " | ".join([*cells, f"{wall:.0f}", f"{processor:.0f}"])


def figures(scene: SparseScene, reference: Path | None, truth: Capture | None) -> list[str]:
    """Count what was found, and compare cameras with the reference and the truth if any."""
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
                f"{found.mean_place_percent:.3f}",
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
    """Give the angle between each view's rotation and the reference's, after alignment."""
    model = read_model(reference)
    number = {name: index for index, name in enumerate(model.names)}
    shared = [index for index, name in enumerate(scene.views.names) if name in number]
    theirs = model.cam_from_world[[number[scene.views.names[index]] for index in shared]]
    mine = scene.cameras.cam_from_world[shared].double()
    # The rotation between the worlds that most views agree on: of all the views' own, the one
    # with the least median angle to the others.
    between = theirs[:, :3, :3].mT @ mine[:, :3, :3]
    trace = torch.einsum("aij,bij->ab", between, between)
    angles = torch.rad2deg(((trace - 1) / 2).clamp(-1, 1).arccos())
    return angles[angles.median(dim=1).values.argmin()]


def cpu_seconds() -> float:
    """Give the processor time this process has used, all threads together."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


if __name__ == "__main__":
    main()
