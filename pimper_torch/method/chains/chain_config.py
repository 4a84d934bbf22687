"""Settings of complete chains, and the presets."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

from pimper_torch.ground.radiometry import Encoding
from pimper_torch.method.coarse.coarse_config import CoarseSurfaceConfig, RemeshConfig
from pimper_torch.method.fusion.fuse_config import FuseConfig
from pimper_torch.method.meshing.meshing_config import ExtractConfig
from pimper_torch.method.patches.patches_config import DecomposeConfig, WarpConfig
from pimper_torch.method.photometry.photometry_config import FactorizeConfig, FitLightConfig
from pimper_torch.method.sfm.reconstruct_config import ReconstructConfig
from pimper_torch.method.silhouettes.silhouette_config import SilhouetteConfig
from pimper_torch.method.sweep.sweep_config import SweepConfig
from pimper_torch.published.published_config import AlignConfig, RefineConfig, TriangulateConfig
from pimper_torch.runtime.config import (
    Range,
    build,
    bytes_of,
    find_config,
    overlay,
    read_mapping,
    require,
    require_ranges,
)
from pimper_torch.runtime.errors import OnFailure


@dataclass(frozen=True, slots=True, kw_only=True)
class CoarseToFineConfig:
    """Settings of every stage of the coarse-to-fine chain, in the order in which they run.

    Attributes:
        chain: Name of the chain.
        on_failure: If a patch, view or solver fails, omit it and continue (skip), or stop (fail).
        max_memory: Such as 4GB. A larger surface is fused in blocks, or refused in the first pass.
        hold_out: Every N-th photograph is held out, and predicted at the end; 0 holds out none.
        scales: Scale of the photographs in each pass, coarse to fine; 1 is full size.
        photographs: ``encoding`` of :func:`~pimper_torch.doors.io.photographs.load_views`.
    """

    chain: ClassVar[str] = "coarse-to-fine"
    on_failure: OnFailure = "skip"
    max_memory: str = ""
    hold_out: Annotated[int, Range(least=0, most=1_000_000)] = 0
    scales: tuple[float, ...] = (0.25, 0.5, 1.0)
    photographs: Encoding = field(default_factory=Encoding)
    reconstruct: ReconstructConfig = field(default_factory=ReconstructConfig)
    silhouettes: SilhouetteConfig = field(default_factory=SilhouetteConfig)
    coarse_surface: CoarseSurfaceConfig = field(default_factory=CoarseSurfaceConfig)
    decompose: DecomposeConfig = field(default_factory=DecomposeConfig)
    warp: WarpConfig = field(default_factory=WarpConfig)
    light: FitLightConfig = field(default_factory=FitLightConfig)
    factorize: FactorizeConfig = field(default_factory=FactorizeConfig)
    sweep: SweepConfig = field(default_factory=SweepConfig)
    fuse: FuseConfig = field(default_factory=FuseConfig)
    remesh: RemeshConfig = field(default_factory=RemeshConfig)
    extract: ExtractConfig = field(default_factory=ExtractConfig)

    def __post_init__(self) -> None:
        bytes_of(self.max_memory)
        require_ranges(self)
        require(self.hold_out != 1, "hold_out", self.hold_out, "0, or at least 2")
        # Photographs have no detail between pixels, and memory grows with the square of the scale.
        sound = bool(self.scales) and all(0 < scale <= 4 for scale in self.scales)
        require(sound, "scales", self.scales, "at least one, each above 0 and at most 4")


@dataclass(frozen=True, slots=True, kw_only=True)
class PublishedConfig:
    """Settings of every stage of the published chain, in the order in which they run.

    Attributes:
        chain: Name of the chain.
        on_failure: If a patch, view or solver fails, omit it and continue (skip), or stop (fail).
        photographs: ``encoding`` of :func:`~pimper_torch.doors.io.photographs.load_views`.
    """

    chain: ClassVar[str] = "published"
    on_failure: OnFailure = "skip"
    photographs: Encoding = field(default_factory=Encoding)
    reconstruct: ReconstructConfig = field(default_factory=ReconstructConfig)
    silhouettes: SilhouetteConfig = field(default_factory=SilhouetteConfig)
    triangulate: TriangulateConfig = field(default_factory=TriangulateConfig)
    coarse_surface: CoarseSurfaceConfig = field(default_factory=CoarseSurfaceConfig)
    decompose: DecomposeConfig = field(default_factory=DecomposeConfig)
    warp: WarpConfig = field(default_factory=WarpConfig)
    light: FitLightConfig = field(default_factory=FitLightConfig)
    factorize: FactorizeConfig = field(default_factory=FactorizeConfig)
    align: AlignConfig = field(default_factory=AlignConfig)
    refine: RefineConfig = field(default_factory=RefineConfig)
    extract: ExtractConfig = field(default_factory=ExtractConfig)


Config = CoarseToFineConfig | PublishedConfig


def load_config(
    name_or_path: str | Path = "default", changes: Mapping[str, object] | None = None
) -> Config:
    """Read the settings of a preset or of a YAML file; the file contains only changes to defaults.

    Args:
        name_or_path: ``"default"``, ``"paper"``, ``"fast"``, or a file. Its ``chain`` selects the
            chain: ``coarse-to-fine``, the default, or ``published``.
        changes: Override the file, nested by stage as in it.

    Raises:
        ConfigError: Names the file or `changes`, section and key, and the nearest valid one.
    """
    path = find_config(name_or_path)
    settings = read_mapping(path)
    config = _built(settings, str(path))
    return _built(overlay(settings, changes), "changes") if changes else config


def _built(settings: Mapping[str, object], where: str) -> Config:
    chain = settings.get("chain", CoarseToFineConfig.chain)
    configs = (CoarseToFineConfig, PublishedConfig)
    matching = [config for config in configs if config.chain == chain]
    names = " or ".join(config.chain for config in configs)
    require(len(matching) == 1, f"{where}: chain", chain, names)
    config: type[Config] = matching[0]
    return build(config, settings, where)
