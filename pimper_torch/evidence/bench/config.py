"""Settings of the table."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pimper_torch.config import Range, require, require_ranges
from pimper_torch.evidence.metrics.evaluate import EvaluateConfig
from pimper_torch.evidence.scenes.config import SceneConfig

SCENES = ("mug", "jar", "balls", "potatoes")
METHODS = {
    "quick": ("default", "smoothed"),
    "full": ("default", "paper", "smoothed", "openmvs"),
}
"""What each scale runs by default."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchConfig:
    """Which methods run on which scenes, and how large the scenes are.

    Attributes:
        scale: quick: 16 photographs of 640x480 a scene; full: 30 of 1600x1200.
        scenes: Names of rendered scenes, or folders that `pimper render` wrote.
        methods: Presets, YAML files of settings, and baselines. By default those of the scale:
            quick runs default and smoothed; full also paper and openmvs.
        masks: Give the methods the true masks of the object; without, they see the table too.
        cameras: found by structure from motion, once a scene and the same for all methods; by
            its features alone (``reconstruct.track_iterations: 0``); or the true ones with a true
            cloud.
        seed: Of scenes and samples.
        samples: On each surface, for distances between surfaces.
        processes: That render at the same time.
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
        """Refuse a table without rows."""
        require_ranges(self)
        require(len(self.scenes) > 0, "scenes", self.scenes, "one scene or more")
        require(len(self.chosen_methods) > 0, "methods", self.methods, "one method or more")
        for name, given in (("scenes", self.scenes), ("methods", self.chosen_methods)):
            labels = {Path(one).stem for one in given}
            require(len(labels) == len(given), name, given, "each name only once, of files too")

    @property
    def chosen_methods(self) -> tuple[str, ...]:
        """The methods given, or those of the scale."""
        return METHODS[self.scale] if self.methods is None else self.methods

    @property
    def evaluation(self) -> EvaluateConfig:
        """How the surfaces are measured."""
        return EvaluateConfig(seed=self.seed, samples=self.samples)

    @property
    def scene(self) -> SceneConfig:
        """How the scenes are photographed at this scale."""
        if self.scale == "full":
            return SceneConfig(seed=self.seed)
        return SceneConfig(seed=self.seed, num_views=16, width=640, height=480)
