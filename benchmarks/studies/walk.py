"""How structure from motion grows with the number of photographs: CPU seconds of its parts."""

from collections import defaultdict
from collections.abc import Callable
from functools import partial, wraps
from typing import Any

import torch
from bench_runs import cpu_seconds
from declared import Figures, Place, Row, Study, Table, figure, listed

from pimper_bench.datasets import read_rendered
from pimper_bench.metrics.estimates import Estimate
from pimper_bench.metrics.evaluation import camera_figures
from pimper_torch.io.photographs import load_views
from pimper_torch.records import Mesh
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
SHOWN = ("features", "pairs", "matching", "mapping", "tracks", "doubts", "all")


def measure(place: Place, num_views: int) -> Figures:
    """Run structure from motion on a walk around a mug, and compare its cameras."""
    size = {"num_views": num_views, "width": 320, "height": 240}
    folder = place.scene("mug", path="handheld", table="patterned", **size)
    spent = Spent(float)
    for module, name, part in PARTS:
        setattr(module, name, timed(getattr(module, name), part, spent))
    views = load_views(folder / "photos")
    capture = read_rendered(folder, maps=False, photographs=False)
    whole = timed(reconstruct.structure_from_motion, "all", spent)
    model = whole(views, ReconstructConfig())
    scene = assemble_scene(views, model)
    cloud = Mesh(vertices_world=scene.points_world, faces=torch.zeros(0, 3, dtype=torch.long))
    estimate = Estimate(mesh=cloud, names=scene.views.names, cameras=scene.cameras)
    found = camera_figures(estimate, capture)
    assert found is not None, "a walk has several cameras"
    return {
        **spent,
        "each": spent["all"] / num_views,
        "registered": model.num_views,
        "points": len(model.points_world),
        "centres": found.mean_center_percent,
        "rotation": found.mean_rotation_deg,
        "focal": found.mean_focal_percent,
    }


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


STUDY = Study(
    name="walk",
    rows={(str(count),): Row(measure=partial(measure, num_views=count)) for count in (30, 120)},
    tables=[
        Table(
            name="walk",
            document="benchmarks/README.md",
            lines=listed(
                ["photographs"],
                [
                    *(figure(part, part, 1) for part in SHOWN),
                    figure("a photograph", "each"),
                    figure("registered", "registered", 0),
                    figure("points", "points", 0),
                    figure("centres, %", "centres", 4),
                    figure("rotation, °", "rotation", 4),
                    figure("focal length, %", "focal", 3),
                ],
            ),
        )
    ],
)
