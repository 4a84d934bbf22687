"""Settings of the coarse-to-fine chain."""

from dataclasses import dataclass, field
from typing import Annotated, ClassVar

from pimper_torch.radiometry import Encoding
from pimper_torch.runtime.config import Range, bytes_of, require, require_ranges
from pimper_torch.runtime.errors import OnFailure
from pimper_torch.stages.coarse.coarse_config import CoarseSurfaceConfig, RemeshConfig
from pimper_torch.stages.fusion.fuse_config import FuseConfig
from pimper_torch.stages.meshing.meshing_config import ExtractConfig
from pimper_torch.stages.patches.patches_config import DecomposeConfig, WarpConfig
from pimper_torch.stages.photometry.photometry_config import FactorizeConfig, FitLightConfig
from pimper_torch.stages.sfm.reconstruct_config import ReconstructConfig
from pimper_torch.stages.silhouettes.silhouette_config import SilhouetteConfig
from pimper_torch.stages.sweep.sweep_config import SweepConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class CoarseToFineConfig:
    """Settings of every stage of the coarse-to-fine chain, in the order in which they run.

    Attributes:
        chain: Name of the chain.
        on_failure: If a patch, view or solver fails, omit it and continue (skip), or stop (fail).
        max_memory: Such as 4GB. A larger surface is fused in blocks, or refused in the first pass.
        hold_out: Every N-th photograph is held out, and predicted at the end; 0 holds out none.
        scales: Scale of the photographs in each pass, coarse to fine; 1 is full size.
        photographs: ``encoding`` of :func:`~pimper_torch.io.photographs.load_views`.
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
