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
from pimper_torch.coarse.remesh import Remesh, RemeshConfig
from pimper_torch.coarse.surface import CoarseSurface, CoarseSurfaceConfig
from pimper_torch.config import require
from pimper_torch.errors import caution, held
from pimper_torch.fusion.fuse import Fuse, FuseConfig
from pimper_torch.kernels.switch import Kernels
from pimper_torch.memory import bytes_of, release_memory, require_memory
from pimper_torch.meshing.extract import Extract, ExtractConfig
from pimper_torch.meshing.repair import Repair
from pimper_torch.patches.decompose import Decompose, DecomposeConfig
from pimper_torch.patches.sources import Sources
from pimper_torch.patches.warp import Warp, WarpConfig
from pimper_torch.photometry.factorize import Factorize, FactorizeConfig
from pimper_torch.radiometry import Encoding
from pimper_torch.records import (
    Cameras,
    CoarseMesh,
    Mesh,
    PatchSet,
    Record,
    Silhouettes,
    SparseScene,
    Surface,
    SweptPatches,
    Views,
)
from pimper_torch.reporting import Observer
from pimper_torch.sfm.reconstruct import Reconstruct, ReconstructConfig
from pimper_torch.silhouettes.contours import Contours, TraceContours
from pimper_torch.silhouettes.correct import CorrectSilhouettes, change
from pimper_torch.silhouettes.find import FindSilhouettes, masked
from pimper_torch.silhouettes.settings import SilhouetteConfig
from pimper_torch.sweep.sweep import Sweep, SweepConfig

# Change of a view's silhouette, one less intersection over union, above which the coarse surface is
# made again. The armadillo of one colour, 24 views of 800x600, where it was 0.022: accuracy
# 1.11 -> 0.88 % of the diagonal, normals 15.6 -> 14.2 degrees; later passes alone do not get there.
_MOVED = 0.015


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
    silhouettes: SilhouetteConfig = field(default_factory=SilhouetteConfig)
    coarse_surface: CoarseSurfaceConfig = field(default_factory=CoarseSurfaceConfig)
    decompose: DecomposeConfig = field(default_factory=DecomposeConfig)
    warp: WarpConfig = field(default_factory=WarpConfig)
    factorize: FactorizeConfig = field(default_factory=FactorizeConfig)
    sweep: SweepConfig = field(default_factory=SweepConfig)
    fuse: FuseConfig = field(default_factory=FuseConfig)
    remesh: RemeshConfig = field(default_factory=RemeshConfig)
    extract: ExtractConfig = field(default_factory=ExtractConfig)

    def __post_init__(self) -> None:
        bytes_of(self.max_memory)
        sound = bool(self.scales) and all(scale > 0 for scale in self.scales)
        require(sound, "scales", self.scales, "one at least, above 0 each")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Confined(Record):
    """The scene as silhouettes confine it.

    Attributes:
        scene: Photographs, masked, with cameras and cloud.
        silhouettes: Of all views.
        contours: What they say about the surface.
    """

    scene: SparseScene
    silhouettes: Silhouettes
    contours: Contours


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
        self.silhouettes = FindSilhouettes(config.silhouettes)
        self.correct: Callable[[SparseScene, Silhouettes, Mesh], Silhouettes] = CorrectSilhouettes(
            config.silhouettes
        )
        self.contours: Callable[[Silhouettes, Cameras], Contours] = TraceContours()
        self.coarse_surface: Callable[[SparseScene, Contours, Mesh | None], CoarseMesh] = (
            CoarseSurface(config.coarse_surface)
        )
        self.decompose = Decompose(config.decompose)
        self.warp: Warping = Warp(config.warp)
        self.factorize: Factorizing = Factorize(config.factorize)
        self.sweep: Sweeping = Sweep(config.sweep)
        self.fuse: Callable[[SweptPatches, Contours, bool], Surface] = Fuse(config.fuse)
        self.repair: Callable[[Surface], Surface] = Repair()
        self.remesh: Callable[[SweptPatches, Surface, Contours], CoarseMesh] = Remesh(config.remesh)
        self.extract = Extract(config.extract)
        self._swap(stages)

    def passes(
        self, views: Views | SparseScene, sparse_model: Path | str | None, mesh: Mesh | None
    ) -> Iterator[Step]:
        """Run the stages behind the coarse mesh once a scale.

        The first pass runs again where the surface that it gives corrects the silhouettes.
        """
        placed = self.placed(views, sparse_model)
        confined = self._confined(placed, self.silhouettes(placed))
        coarse = self.coarse_surface(confined.scene, confined.contours, mesh)
        sources = self._sources(confined.scene.views)
        heights: SweptPatches | None = None
        surface: Surface | None = None
        first, last = self.config.scales[0], len(self.config.scales)
        for number, scale in enumerate(self.config.scales, start=1):
            with held() as cautions:
                if heights is not None and surface is not None:
                    coarse = self.remesh(heights, surface, confined.contours)
                patches = self.decompose(coarse, placed.cameras, surface, scale)
                if number == 1:
                    limit = bytes_of(self.config.max_memory)
                    require_memory(limit, patches, first, self.config.scales[-1])
                heights = self._heights(confined.scene, patches, sources)
                if number == last > 1:
                    sources = None  # as large as the photographs
                release_memory()
                surface = self.repair(self.fuse(heights, confined.contours, number == last))
                if number == 1:
                    before = confined.silhouettes
                    corrected = self.correct(placed, before, surface.mesh)
                    if change(before, corrected) > _MOVED:
                        confined = self._confined(placed, corrected)
                        coarse = self.coarse_surface(confined.scene, confined.contours, mesh)
                        sources = self._sources(confined.scene.views)
                        patches = self.decompose(coarse, placed.cameras, None, scale)
                        heights = self._heights(confined.scene, patches, sources)
                        surface = self.repair(self.fuse(heights, confined.contours, last == 1))
            if number == last:  # what earlier passes would warn of as well
                for message in cautions:
                    caution(message, stacklevel=3)
            yield Step(
                scale=scale,
                last=number == last,
                scene=confined.scene,
                silhouettes=confined.silhouettes,
                heights=heights,
                surface=surface,
            )

    def _confined(self, placed: SparseScene, silhouettes: Silhouettes) -> _Confined:
        """Confine the scene to what silhouettes show."""
        scene = masked(placed, silhouettes)
        return _Confined(
            scene=scene,
            silhouettes=silhouettes,
            contours=self.contours(silhouettes, scene.cameras),
        )

    def _sources(self, views: Views) -> Sources | None:
        """Prepare photographs for the warp, if it wants them so."""
        return self.warp.prepare(views) if isinstance(self.warp, Prepares) else None

    def _heights(
        self, scene: SparseScene, patches: PatchSet, sources: Sources | None
    ) -> SweptPatches:
        """Give normals, albedo, light and swept heights of all patches."""
        return photometry_and_heights(
            self.warp, self.factorize, self.sweep, scene.views, scene.cameras, patches, sources
        )
