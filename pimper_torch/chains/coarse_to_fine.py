"""The chain from coarse to fine: all facets together, each pass on the surface before."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from torch import nn

from pimper_torch.chains.chain import Chain, Step
from pimper_torch.chains.streaming import (
    Factorizing,
    Prepares,
    Sweeping,
    Warping,
    photometry_and_heights,
)
from pimper_torch.coarse.adapt import Adapt, AdaptConfig
from pimper_torch.coarse.enclose import Enclose, EncloseConfig
from pimper_torch.config import require
from pimper_torch.errors import caution, held
from pimper_torch.fusion.fuse import Fuse, FuseConfig
from pimper_torch.kernels.switch import Kernels
from pimper_torch.memory import bytes_of, release_memory, require_memory
from pimper_torch.meshing.extract import Extract, ExtractConfig
from pimper_torch.meshing.mend import Mend
from pimper_torch.outlines.outline import Outline, OutlineConfig, masked
from pimper_torch.patches.decompose import Decompose, DecomposeConfig
from pimper_torch.patches.warp import Warp, WarpConfig
from pimper_torch.photometry.factorize import Factorize, FactorizeConfig
from pimper_torch.radiometry import Encoding
from pimper_torch.records import (
    Cameras,
    CoarseMesh,
    Mesh,
    Outlines,
    SparseScene,
    Surface,
    SweptPatches,
    Views,
)
from pimper_torch.reporting import Observer
from pimper_torch.rims.constraints import Rim, Rims
from pimper_torch.sfm.reconstruct import Reconstruct, ReconstructConfig
from pimper_torch.sweep.sweep import Sweep, SweepConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class CoarseToFineConfig:
    """The settings of every stage of the chain from coarse to fine, in the order they run.

    Attributes:
        chain: Which chain these are the settings of.
        kernels: Whether compiled kernels stand in for torch on the CPU, where no gradients are
            asked for (numba), or nowhere (torch).
        max_memory: That the process may hold, such as 4GB. A run whose last pass would take more
            is refused in its first, with what would be needed. Nothing is no limit.
        scales: Of the photographs, one a pass, coarse to fine; 1 is their own size.
        photographs: What :func:`~pimper_torch.io.photographs.load_views` takes as ``encoding``.
    """

    chain: ClassVar[str] = "coarse-to-fine"
    kernels: Kernels = "numba"
    max_memory: str = ""
    scales: tuple[float, ...] = (0.25, 0.5, 1.0)
    photographs: Encoding = field(default_factory=Encoding)
    reconstruct: ReconstructConfig = field(default_factory=ReconstructConfig)
    outline: OutlineConfig = field(default_factory=OutlineConfig)
    enclose: EncloseConfig = field(default_factory=EncloseConfig)
    decompose: DecomposeConfig = field(default_factory=DecomposeConfig)
    warp: WarpConfig = field(default_factory=WarpConfig)
    factorize: FactorizeConfig = field(default_factory=FactorizeConfig)
    sweep: SweepConfig = field(default_factory=SweepConfig)
    fuse: FuseConfig = field(default_factory=FuseConfig)
    adapt: AdaptConfig = field(default_factory=AdaptConfig)
    extract: ExtractConfig = field(default_factory=ExtractConfig)

    def __post_init__(self) -> None:
        bytes_of(self.max_memory)
        sound = bool(self.scales) and all(scale > 0 for scale in self.scales)
        require(sound, "scales", self.scales, "one at least, above 0 each")


class CoarseToFine(Chain):
    """A closed surface of what all views see, remeshed and fused again at every scale.

    Patches come a few at a time to a factorization that can be called so
    (:class:`~pimper_torch.chains.streaming.InParts`), and all at once to others.
    """

    def __init__(
        self,
        config: CoarseToFineConfig | None = None,
        observer: Observer | None = None,
        cache: Path | str | None = None,
        **stages: nn.Module,
    ) -> None:
        self.config = config = config or CoarseToFineConfig()
        super().__init__(config.kernels, observer)
        self.reconstruct = Reconstruct(config.reconstruct, cache)
        self.outline = Outline(config.outline)
        self.rim: Callable[[Outlines, Cameras], Rims] = Rim()
        self.enclose: Callable[[SparseScene, Rims, Mesh | None], CoarseMesh] = Enclose(
            config.enclose
        )
        self.decompose = Decompose(config.decompose)
        self.warp: Warping = Warp(config.warp)
        self.factorize: Factorizing = Factorize(config.factorize)
        self.sweep: Sweeping = Sweep(config.sweep)
        self.fuse: Callable[[SweptPatches, Rims, bool], Surface] = Fuse(config.fuse)
        self.mend: Callable[[Surface], Surface] = Mend()
        self.adapt: Callable[[SweptPatches, Surface, Rims], CoarseMesh] = Adapt(config.adapt)
        self.extract = Extract(config.extract)
        self._swap(stages)

    def passes(
        self, views: Views | SparseScene, sparse_model: Path | str | None, mesh: Mesh | None
    ) -> Iterator[Step]:
        """Run the stages behind the coarse mesh once a scale."""
        scene = self.placed(views, sparse_model)
        outlines = self.outline(scene)
        scene = masked(scene, outlines)
        cameras = scene.cameras
        rims = self.rim(outlines, cameras)
        coarse = self.enclose(scene, rims, mesh)
        sources = self.warp.prepare(scene.views) if isinstance(self.warp, Prepares) else None
        heights: SweptPatches | None = None
        surface: Surface | None = None
        first, last = self.config.scales[0], len(self.config.scales)
        for number, scale in enumerate(self.config.scales, start=1):
            with held() as cautions:
                if heights is not None and surface is not None:
                    coarse = self.adapt(heights, surface, rims)
                patches = self.decompose(coarse, cameras, surface, scale)
                if number == 1:
                    limit = bytes_of(self.config.max_memory)
                    require_memory(limit, patches, first, self.config.scales[-1])
                heights = photometry_and_heights(
                    self.warp, self.factorize, self.sweep, scene.views, cameras, patches, sources
                )
                if number == last:
                    sources = None  # as much memory as the photographs themselves
                release_memory()
                surface = self.mend(self.fuse(heights, rims, number == last))
            if number == last:  # what earlier passes would warn of as well
                for message in cautions:
                    caution(message, stacklevel=3)
            yield Step(
                scale=scale,
                last=number == last,
                scene=scene,
                outlines=outlines,
                heights=heights,
                surface=surface,
            )
