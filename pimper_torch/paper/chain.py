"""The published chain: facets are reconstructed separately, then joined."""

from collections.abc import Callable, Iterator
from pathlib import Path

from torch import nn

from pimper_torch.chains.chain import Chain, Step
from pimper_torch.chains.photometric import Factorizing, WarpStage
from pimper_torch.chains.prepare import Prepared
from pimper_torch.chains.running import ChainRun
from pimper_torch.geometry.contours import Contours
from pimper_torch.paper.align import Align
from pimper_torch.paper.integrate import Integrate
from pimper_torch.paper.paper_config import PublishedConfig
from pimper_torch.paper.refine import Refine
from pimper_torch.paper.triangulate import Triangulate
from pimper_torch.records import (
    CoarseMesh,
    DepthPatches,
    Mesh,
    PatchViews,
    PhotometricPatches,
    Silhouettes,
    SparseScene,
    Surface,
)
from pimper_torch.runtime.reporting import Observer
from pimper_torch.stages.coarse.surface import CoarseSurface
from pimper_torch.stages.meshing.extract import Extract
from pimper_torch.stages.patches.decompose import Decompose
from pimper_torch.stages.patches.warp import Warp
from pimper_torch.stages.photometry.factorize import Factorize
from pimper_torch.stages.photometry.fit_light import FitLight, Illumination
from pimper_torch.stages.photometry.gauge import FixGauge
from pimper_torch.stages.sfm.reconstruct import Reconstruct
from pimper_torch.stages.silhouettes.find import FindSilhouettes
from pimper_torch.store import Store, opened


class Published(Chain):
    """Chain of facets between points of the cloud, each with depth from its normals, then joined.

    Source: Sabzevari, Del Bue, Murino: PiMPeR, piecewise dense 3D reconstruction from
    multi-view and multi-illumination images, 2015.
    """

    def __init__(
        self,
        config: PublishedConfig | None = None,
        observer: Observer | None = None,
        cache: Store | Path | str | None = None,
        **stages: nn.Module,
    ) -> None:
        self.config = config = config or PublishedConfig()
        store = opened(cache)
        super().__init__(observer, store, config.on_failure)
        self.reconstruct = Reconstruct(config.reconstruct, store)
        self.silhouettes = FindSilhouettes(config.silhouettes)
        self.triangulate: Callable[[SparseScene], CoarseMesh] = Triangulate(config.triangulate)
        self.coarse_surface: Callable[[SparseScene, Contours, Mesh], CoarseMesh] = CoarseSurface(
            config.coarse_surface
        )
        self.decompose = Decompose(config.decompose)
        self.warp: WarpStage = Warp(config.warp)
        self.light: Callable[[PatchViews], Illumination] = FitLight(config.light)
        self.factorize: Factorizing = Factorize(config.factorize)
        self.gauge: Callable[[PhotometricPatches], PhotometricPatches] = FixGauge(config.factorize)
        self.integrate: Callable[[PhotometricPatches], DepthPatches] = Integrate()
        self.align: Callable[[DepthPatches], DepthPatches] = Align(config.align)
        self.refine: Callable[[DepthPatches], Surface] = Refine(config.refine)
        self.extract = Extract(config.extract)
        self._swap(stages)

    def first_surface(
        self, run: ChainRun, scene: SparseScene, silhouettes: Silhouettes, mesh: Mesh | None
    ) -> tuple[Contours, CoarseMesh]:
        """Triangulate points of the cloud; see :meth:`Chain.first_surface`."""
        contours = Contours.none(silhouettes, scene.cameras)
        if mesh is None:
            return contours, run(self.triangulate, scene)
        return contours, run(self.coarse_surface, scene, contours, mesh)

    def passes(self, run: ChainRun, prepared: Prepared) -> Iterator[Step]:
        """Run the stages once; see :meth:`Chain.passes`."""
        scene = prepared.scene
        patches = run(self.decompose, prepared.coarse, scene.cameras, None, 1.0)
        seen = run(self.warp, scene.views, scene.cameras, patches)
        photometric = run(self.gauge, run(self.factorize, seen, run(self.light, seen)))
        heights = run(self.align, run(self.integrate, photometric))
        surface = run(self.refine, heights)
        yield Step(scale=1.0, last=True, prepared=prepared, heights=heights, surface=surface)
