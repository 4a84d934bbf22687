"""Compare settings of structure from motion on folders of photographs.

Each view's rotation is compared with a reference: a COLMAP model with the same image names, or
LLFF's ``poses_bounds.npy``. A view more than 2 degrees off is wrong.
"""

import dataclasses
import warnings
from functools import partial
from pathlib import Path

import torch
from bench_runs import cpu_seconds
from declared import DATA, Figures, Place, Row, Study, Table, figure, listed, said
from torch import Tensor

from pimper_bench.datasets import read_llff
from pimper_torch.cli.options import bundled_photographs
from pimper_torch.io.cameras.model_files import read_model
from pimper_torch.io.photographs import load_views
from pimper_torch.records import SparseScene
from pimper_torch.runtime.errors import PimperWarning, ReconstructionError
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


OURS = ReconstructConfig()
UNGUIDED = dataclasses.replace(OURS, guided_pairs=0, starts=0, track_iterations=0)
SETTINGS = {
    "COLMAP's": COLMAP,
    "contrast 0.002, affine, 2 px": UNGUIDED,
    "`default`": OURS,
}
# Photographs, their reference, and the longest side in pixels.
SETS = {
    "skull, 26": (bundled_photographs(), DATA / "skull_flash" / "our_colmap_sparse_txt", 0),
    "carton, 43": (DATA / "milk" / "images", DATA / "milk", 800),
}


def measure(place: Place, photographs: str, settings: str) -> Figures:
    """Run structure from motion, and compare rotations with the reference."""
    folder, reference, size = SETS[photographs]
    views = load_views(place.photographs(folder), max_size_px=size)
    began = cpu_seconds()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PimperWarning)
        try:
            scene = Reconstruct(SETTINGS[settings])(views)
        except ReconstructionError:
            return {"views": "refused", "CPU s": cpu_seconds() - began}
    seconds = cpu_seconds() - began
    length, figures = torch.bincount(scene.observation_point), {}
    if reference.exists():
        angles = rotation_errors_deg(scene, reference)
        figures = {"wrong": int((angles > 2).sum()), "rotation": float(angles.median())}
    return figures | {
        "views": f"{scene.views.num_views} of {views.num_views}",
        "points": len(length),
        "track": float(length.double().mean()),
        "error": float(scene.reprojection_errors_px.mean()),
        "CPU s": seconds,
    }


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


STUDY = Study(
    name="sfm",
    rows={
        (photographs, settings): Row(
            measure=partial(measure, photographs=photographs, settings=settings)
        )
        for photographs in SETS
        for settings in SETTINGS
    },
    tables=[
        Table(
            name="sfm",
            document="benchmarks/README.md",
            labels=2,
            lines=listed(
                ["photographs", "settings"],
                [
                    said("views", "views"),
                    figure("points", "points", 0),
                    figure("mean track", "track"),
                    figure("error, px", "error"),
                    figure("wrong views", "wrong", 0),
                    figure("median rotation error, °", "rotation"),
                    figure("CPU s", "CPU s", 0),
                ],
            ),
        )
    ],
)
