"""Settings of whole chains, and the presets."""

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
    """The settings of every stage of the chain from coarse to fine, in the order they run.

    Attributes:
        chain: Which chain these are the settings of.
        on_failure: Leave out a patch, view or solver that fails and go on (skip), or end (fail).
        max_memory: Such as 4GB: a surface that would take more is fused by blocks, or refused in
            the first pass.
        hold_out: Predict every N-th photograph at the end, from the others alone; 0 holds out none.
        scales: Of the photographs, one a pass, coarse to fine; 1 is their own size.
        photographs: What :func:`~pimper_torch.doors.io.photographs.load_views` takes as
            ``encoding``.
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
        require(self.hold_out != 1, "hold_out", self.hold_out, "0, or 2 at least")
        # Photographs hold nothing between their pixels, and memory goes with the square.
        sound = bool(self.scales) and all(0 < scale <= 4 for scale in self.scales)
        require(sound, "scales", self.scales, "one at least, above 0 and at most 4 each")


@dataclass(frozen=True, slots=True, kw_only=True)
class PublishedConfig:
    """The settings of every stage of the published chain, in the order they run.

    Attributes:
        chain: Which chain these are the settings of.
        on_failure: Leave out a patch, view or solver that fails and go on (skip), or end (fail).
        photographs: What :func:`~pimper_torch.doors.io.photographs.load_views` takes as
            ``encoding``.
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
    """Read a preset, or a YAML file of one's own, which holds only what differs.

    Args:
        name_or_path: ``"default"``, ``"paper"``, ``"fast"``, or a file. Its ``chain`` says which
            chain it is for: ``coarse-to-fine`` unless given, or ``published``.
        changes: Laid over the file, nested by stage like it.

    Raises:
        ConfigError: Names the file or `changes`, section and key, and the nearest valid one.
    """
    path = find_config(name_or_path)
    settings = read_mapping(path)
    config = _built(settings, str(path))
    return _built(overlay(settings, changes), "changes") if changes else config


def _built(settings: Mapping[str, object], where: str) -> Config:
    chain = settings.get("chain", CoarseToFineConfig.chain)
    found = [config for config in (CoarseToFineConfig, PublishedConfig) if config.chain == chain]
    names = f"{CoarseToFineConfig.chain} or {PublishedConfig.chain}"
    require(len(found) == 1, f"{where}: chain", chain, names)
    config: type[Config] = found[0]
    return build(config, settings, where)
