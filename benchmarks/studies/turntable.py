"""Compare cameras of rendered turntables with the true ones, with and without masks.

Run as ``python benchmarks/studies/turntable.py SCENE [SCENE ...]``, folders that ``pimper render``
wrote with ``--path turntable``; prints rows of a table. ``centres`` is the distance of camera
centres from the true ones after the similarity on cameras, relative to the radius of the camera's
circle around the object.
"""

import argparse
import sys
import time
import warnings
from pathlib import Path

import torch

from pimper_bench.datasets import read_rendered
from pimper_bench.metrics.similarity import similarity_between_cameras
from pimper_torch.geometry.rigid import transform
from pimper_torch.io.photographs import load_views
from pimper_torch.records import Cameras, SparseScene, Views
from pimper_torch.runtime.errors import PimperError, PimperWarning
from pimper_torch.stages.sfm.reconstruct import Reconstruct
from pimper_torch.stages.sfm.reconstruct_config import ReconstructConfig

COLUMNS = ("scene", "masks", "views", "points", "centres %", "worst %", "doubtful", "CPU s")


def main() -> None:
    """Read the command line, run every scene without masks and with them, print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path, help="folders of rendered scenes")
    parser.add_argument("--masks", nargs="+", choices=("none", "true"), default=("none", "true"))
    parser.add_argument("--tracks", type=int, default=2, help="iterations of refining tracks")
    parser.add_argument("--verbose", action="store_true", help="print warnings, too")
    options = parser.parse_args()
    say("| " + " | ".join(COLUMNS) + " |")
    say("|---|---|" + "--:|" * (len(COLUMNS) - 2))
    config = ReconstructConfig(threads=1, track_iterations=options.tracks)
    for folder in options.scenes:
        truth = read_rendered(folder, maps=False, photographs=False)
        for masks in options.masks:
            views = load_views(folder / "photos")
            if masks == "true":
                views = load_views(folder / "photos", masks=folder / "masks")
            began = time.process_time()
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", PimperWarning)
                cells = row(views, config, truth.views.names, truth.cameras)
            seconds = f"{time.process_time() - began:.0f}"
            say("| " + " | ".join([folder.name, masks, *cells, seconds]) + " |")
            if options.verbose:
                say("".join(f"{warning.message}\n" for warning in caught))


def row(
    views: Views, config: ReconstructConfig, names: tuple[str, ...], true: Cameras
) -> list[str]:
    """Run structure from motion once and compare its cameras."""
    try:
        scene = Reconstruct(config)(views)
    except PimperError as error:
        return [f"{type(error).__name__}: {str(error).split(';')[0]}", "", "", "", ""]
    errors = center_errors(scene, names, true)
    doubt = getattr(scene, "diagnosis", None)  # earlier commits lack it
    return [
        f"{scene.views.num_views} of {views.num_views}",
        str(len(scene.points_world)),
        f"{100 * errors.mean():.2f}",
        f"{100 * errors.max():.2f}",
        "" if doubt is None else "yes" if doubt else "no",
    ]


def center_errors(scene: SparseScene, names: tuple[str, ...], true: Cameras) -> torch.Tensor:
    """Return each camera centre's distance from the true one, in radii of the circle."""
    rows = [names.index(name) for name in scene.views.names]
    same = true.replace(
        intrinsics=true.intrinsics[rows],
        cam_from_world=true.cam_from_world[rows],
        sizes_px=true.sizes_px[rows],
    )
    fit = similarity_between_cameras(scene.cameras, same).double()
    ours = transform(fit, scene.cameras.centers_world.double())
    everywhere = true.centers_world.double()
    radius = (everywhere - everywhere.mean(dim=0))[:, :2].norm(dim=1).mean()
    return (ours - everywhere[rows]).norm(dim=1) / radius


def say(line: str) -> None:
    """Write a line of the table at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
