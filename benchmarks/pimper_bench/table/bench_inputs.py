"""Settings, scenes and methods of the bench."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from torch import nn

from pimper_bench.baselines.openmvs import OpenMvs
from pimper_bench.baselines.smoothed import Smoothed
from pimper_bench.datasets.rendered import read_rendered
from pimper_bench.metrics.estimates import Estimate, estimate_of
from pimper_bench.metrics.evaluation import EvaluateConfig, prepared_surface
from pimper_bench.metrics.similarity import pair_views
from pimper_bench.metrics.surface_distances import TrueSurface
from pimper_bench.scenes.rendered_folder import render_scene
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_bench.truth import Capture
from pimper_torch.io.photographs import load_views
from pimper_torch.paper.triangulate import Triangulate
from pimper_torch.presets.load_chain import make_chain
from pimper_torch.presets.load_config import Config, load_config
from pimper_torch.records import CoarseMesh, Record, SparseScene
from pimper_torch.runtime.config import Range, require, require_ranges
from pimper_torch.runtime.errors import ConfigError
from pimper_torch.stages.sfm.reconstruct import Reconstruct, find_model, placed_scene
from pimper_torch.stages.sfm.reconstruct_config import ReconstructConfig
from pimper_torch.store import opened

SCENES = ("mug", "jar", "balls", "potatoes")
METHODS = {"quick": ("default", "smoothed"), "full": ("default", "paper", "smoothed", "openmvs")}
"""Default methods of each scale."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchConfig:
    """Methods and scenes of the bench, and the size of the scenes.

    Attributes:
        scale: quick: 16 photographs of 640x480 per scene; full: 30 of 1600x1200.
        scenes: Names of rendered scenes, or folders that `pimper render` wrote.
        methods: Presets, YAML files of settings, and baselines. By default those of the scale:
            quick runs default and smoothed; full also paper and openmvs.
        masks: Give the true masks of the object to the methods; otherwise they use the table, too.
        cameras: found by structure from motion, once per scene for all methods; by its features
            only (``reconstruct.track_iterations: 0``); or the true ones with a true cloud.
        seed: Of scenes and samples.
        samples: Number on each surface, for distances between surfaces.
        processes: Number of concurrent renderings.
    """

    scale: Literal["quick", "full"] = "quick"
    scenes: tuple[str, ...] = SCENES
    methods: tuple[str, ...] | None = None
    masks: bool = False
    cameras: Literal["found", "features", "true"] = "found"
    seed: Annotated[int, Range(least=0, most=2**32 - 1)] = 0  # 32 bits
    samples: Annotated[int, Range(least=1, most=10_000_000)] = 50_000  # 100 bytes each
    processes: Annotated[int, Range(least=1, most=1024)] = 2

    def __post_init__(self) -> None:
        """Refuse an empty table, duplicates and values out of range."""
        require_ranges(self)
        require(len(self.scenes) > 0, "scenes", self.scenes, "at least one scene")
        require(len(self.chosen_methods) > 0, "methods", self.methods, "at least one method")
        for name, given in (("scenes", self.scenes), ("methods", self.chosen_methods)):
            labels = {Path(value).stem for value in given}
            require(len(labels) == len(given), name, given, "different names, also of files")

    @property
    def chosen_methods(self) -> tuple[str, ...]:
        """The given methods, or those of the scale."""
        return METHODS[self.scale] if self.methods is None else self.methods

    @property
    def evaluation(self) -> EvaluateConfig:
        """Settings of the evaluation."""
        return EvaluateConfig(seed=self.seed, samples=self.samples)

    @property
    def scene(self) -> SceneConfig:
        """Settings of the rendered scenes at this scale."""
        if self.scale == "full":
            return SceneConfig(seed=self.seed)
        return SceneConfig(seed=self.seed, num_views=16, width=640, height=480)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Inputs(Record):
    """Inputs of the methods for a scene.

    Attributes:
        scene: Photographs, and cameras and cloud, estimated or true.
        coarse: Facets for the baselines that need them; those of ``triangulate``.
        capture: The truth, without photographs and maps.
        maps: The truth in the methods' reference view; maps of all views would fill the memory.
        sfm_seconds: Wall clock of structure from motion; 0 with true cameras.
    """

    scene: SparseScene
    coarse: CoarseMesh
    capture: Capture
    surface: TrueSurface
    maps: Capture
    sfm_seconds: float


def scene_folder(name: str, config: BenchConfig, workspace: Path) -> Path:
    """Render a scene, or return the folder that `pimper render` wrote."""
    if (Path(name) / "truth").is_dir():
        return Path(name)
    folder = workspace / Path(name).stem
    return render_scene(name, folder, config.scene, processes=config.processes)


def prepare(folder: Path, config: BenchConfig, cache: Path | str | None = None) -> Inputs:
    """Read a rendered scene from its files, as a user would, and estimate its cameras.

    Args:
        cache: Folder of models estimated before, with the seconds that they took.
    """
    views = load_views(folder / "photos", masks=folder / "masks" if config.masks else None)
    if config.cameras == "true":
        scene, seconds = Reconstruct()(views, folder / "truth" / "sparse"), 0.0
    else:
        default = ReconstructConfig()
        settings = replace(default, track_iterations=0) if config.cameras == "features" else default
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


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class MethodRun(Record):
    """A method's estimate, and its cost.

    Attributes:
        seconds: Wall clock without structure from motion.
        counts: Figures of its stages, such as ``samples``: all templates' samples times views,
            including missing ones.
        external: Whether another program did the work, with memory outside this process.
    """

    estimate: Estimate
    seconds: float
    counts: Mapping[str, int | float] = field(default_factory=dict)
    external: bool = False


Method = Callable[[SparseScene, CoarseMesh], MethodRun]

_BASELINES: dict[str, Callable[[], nn.Module]] = {"smoothed": Smoothed, "openmvs": OpenMvs}


def method_named(name: str, cache: Path | None = None) -> Method:
    """Return a baseline by name, or a preset, or a YAML file of settings.

    Args:
        cache: Folder of a preset's stages, which are not repeated in runs with other settings.
    """
    if name in _BASELINES:
        return partial(_run_baseline, _BASELINES[name]())
    try:
        return partial(_run_preset, load_config(name), cache)
    except ConfigError as error:
        raise ConfigError(
            f"method {name!r}: {error} Baselines are {', '.join(_BASELINES)}."
        ) from error


def _run_preset(
    config: Config, cache: Path | None, scene: SparseScene, coarse: CoarseMesh
) -> MethodRun:
    chain = make_chain(config, cache=cache)
    began = time.perf_counter()
    result = chain(scene)
    seconds = time.perf_counter() - began
    counts = {key: value for report in result.report for key, value in report.figures.items()}
    return MethodRun(estimate=estimate_of(result), seconds=seconds, counts=counts)


def _run_baseline(module: nn.Module, scene: SparseScene, coarse: CoarseMesh) -> MethodRun:
    began = time.perf_counter()
    estimate = module(scene, coarse)
    return MethodRun(
        estimate=estimate,
        seconds=time.perf_counter() - began,
        external=isinstance(module, OpenMvs),
    )
