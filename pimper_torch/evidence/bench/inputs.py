"""What every method of the table is given: the same cameras, cloud and photographs."""

import time
from dataclasses import dataclass, replace
from pathlib import Path

from pimper_torch.evidence.bench.config import BenchConfig
from pimper_torch.evidence.datasets.rendered import read_rendered
from pimper_torch.evidence.metrics.distances import TrueSurface
from pimper_torch.evidence.metrics.evaluate import prepared_surface
from pimper_torch.evidence.metrics.similarity import pair_views
from pimper_torch.evidence.scenes.write import render_scene
from pimper_torch.io.photographs import load_views
from pimper_torch.paper.triangulate import Triangulate
from pimper_torch.records import Capture, CoarseMesh, Record, SparseScene
from pimper_torch.sfm.reconstruct import (
    Reconstruct,
    find_model,
    placed_scene,
)
from pimper_torch.sfm.settings import ReconstructConfig
from pimper_torch.store import opened


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Inputs(Record):
    """A scene of the table, ready for the methods.

    Attributes:
        scene: Cameras and cloud, found or true, and the photographs.
        coarse: Facets for the baselines that start from some; of the default preset.
        capture: The truth, without photographs and maps.
        maps: Of the methods' reference view alone, for those of all fill the memory.
        sfm_seconds: Wall clock of structure from motion; 0 with true cameras.
    """

    scene: SparseScene
    coarse: CoarseMesh
    capture: Capture
    surface: TrueSurface
    maps: Capture
    sfm_seconds: float


def scene_folder(name: str, config: BenchConfig, workspace: Path) -> Path:
    """Render a scene, or give the folder that `pimper render` wrote.

    Args:
        name: Of a rendered scene, or a folder with ``truth`` in it.
    """
    if (Path(name) / "truth").is_dir():
        return Path(name)
    folder = workspace / Path(name).stem
    return render_scene(name, folder, config.scene, processes=config.processes)


def prepare(folder: Path, config: BenchConfig, cache: Path | str | None = None) -> Inputs:
    """Read a rendered scene and find its cameras, from the files as a user would.

    Args:
        cache: Folder where models are kept; the seconds of one from there are those that it
            took to find.
    """
    views = load_views(folder / "photos", masks=folder / "masks" if config.masks else None)
    if config.cameras == "true":
        scene, seconds = Reconstruct()(views, folder / "truth" / "sparse"), 0.0
    else:
        refined = ReconstructConfig()
        settings = replace(refined, track_iterations=0) if config.cameras == "features" else refined
        model, seconds = find_model(views, settings, opened(cache))
        began = time.perf_counter()
        scene = placed_scene(views, model)
        seconds += time.perf_counter() - began
    coarse = Triangulate()(scene)
    capture = read_rendered(folder, maps=False, photographs=False)
    surface = prepared_surface(capture, config.evaluation)
    assert surface is not None  # a rendered scene has its mesh
    _, (view, *_) = pair_views([scene.views.names[coarse.reference]], capture.views.names)
    return Inputs(
        scene=scene,
        coarse=coarse,
        capture=capture,
        surface=surface,
        maps=read_rendered(folder, views=[int(view)], photographs=False),
        sfm_seconds=seconds,
    )
