"""Measure how structure from motion grows with the number of photographs.

Run as ``python benchmarks/studies/walk.py [--num-views 30 60 120 300] [--scene mug]``: renders
walks around a scene on a patterned table to ``--renderings``, unless they exist, and prints a
Markdown table with the CPU seconds of each part of structure from motion, and the camera errors.
``growth`` is the CPU seconds per photograph relative to the first walk. A row is printed when its
walk is done.
"""

import argparse
import resource
import sys
from collections import defaultdict
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import torch

from pimper_bench.datasets import read_rendered
from pimper_bench.metrics.evaluation import camera_figures
from pimper_bench.scenes.rendered_folder import render_scene
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_bench.table.measure import peak_memory
from pimper_torch.io.photographs import load_views
from pimper_torch.records import Estimate, Mesh
from pimper_torch.stages.sfm import reconstruct, registration
from pimper_torch.stages.sfm.reconstruct_config import ReconstructConfig
from pimper_torch.stages.sfm.sparse_scene import assemble_scene

Spent = defaultdict[str, float]

# Functions by the part of structure from motion that they are, and the module that calls them.
PARTS = (
    (reconstruct, "find_features", "features"),
    (registration, "pairs_to_match", "pairs"),
    (registration, "match_pairs", "matching"),
    (registration, "match_guided", "matching"),
    (registration, "verified_pairs", "matching"),
    (registration, "map_views", "mapping"),
    (registration, "verify_model", "doubts"),
    (registration, "count_views_with_depth", "doubts"),
    (registration, "diagnose", "doubts"),
    (registration, "remove_static_features", "others"),
    (registration, "link_sessions", "others"),
    (reconstruct, "refine_tracks", "tracks"),
)
COLUMNS = (*dict.fromkeys(part for _, _, part in PARTS), "rest", "all", "growth")
FIGURES = ("views", "points", "centres %", "rotation °", "focal %", "peak MB")


def main() -> None:
    """Read the command line, run structure from motion on every walk, print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--num-views", nargs="+", type=int, default=[30, 60, 120, 300])
    parser.add_argument("--scene", default="mug", help="a rendered scene's name, or a mesh file")
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--height", type=int, default=240)
    parser.add_argument("--renderings", type=Path, default=Path("walks"))
    parser.add_argument("--seed", type=int, default=0, help="of structure from motion")
    options = parser.parse_args()
    spent = Spent(float)
    for module, name, part in PARTS:
        setattr(module, name, timed(getattr(module, name), part, spent))
    say("| photographs | " + " | ".join((*COLUMNS, *FIGURES)) + " |")
    say("|--:|" + "--:|" * len(COLUMNS + FIGURES))
    first = None
    for num_views in options.num_views:
        folder = options.renderings / f"{Path(options.scene).stem}{num_views}"
        if not folder.is_dir():
            config = SceneConfig(
                num_views=num_views,
                width=options.width,
                height=options.height,
                path="handheld",
                table="patterned",
            )
            render_scene(options.scene, folder, config)
        spent.clear()
        figures = run(folder, options.seed, spent)
        each = spent["all"] / num_views
        first = first or each
        cells = [f"{spent[part]:.1f}" for part in COLUMNS[:-1]]
        say(" | ".join((f"| {num_views}", *cells, f"{each / first:.2f}", *figures)) + " |")


def run(folder: Path, seed: int, spent: Spent) -> list[str]:
    """Run structure from motion on a rendered walk and return its figures as cells."""
    views = load_views(folder / "photos")
    capture = read_rendered(folder, maps=False, photographs=False)
    config = ReconstructConfig(seed=seed)
    with peak_memory() as peak:
        model = timed(reconstruct.structure_from_motion, "all", spent)(views, config)
        megabytes = peak() or float("nan")
    spent["rest"] = spent["all"] - sum(spent[part] for part in COLUMNS[:-3])
    scene = assemble_scene(views, model)
    cloud = Mesh(vertices_world=scene.points_world, faces=torch.zeros(0, 3, dtype=torch.long))
    estimate = Estimate(mesh=cloud, names=scene.views.names, cameras=scene.cameras)
    found = camera_figures(estimate, capture)
    assert found is not None, "a walk has several cameras"
    return [
        f"{model.num_views}",
        f"{len(model.points_world)}",
        f"{found.mean_center_percent:.4f}",
        f"{found.mean_rotation_deg:.4f}",
        f"{found.mean_focal_percent:.3f}",
        f"{megabytes:.0f}",
    ]


def timed(function: Callable[..., Any], part: str, spent: Spent) -> Callable[..., Any]:
    """Add the CPU seconds of every call to a part's."""

    @wraps(function)
    def measured(*arguments: Any, **named: Any) -> Any:  # noqa: ANN401 - of any function
        before = cpu_seconds()
        try:
            return function(*arguments, **named)
        finally:
            spent[part] += cpu_seconds() - before

    return measured


def cpu_seconds() -> float:
    """Return the processor time that this process has used, all threads together."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def say(line: str) -> None:
    """Write a line of the table at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
