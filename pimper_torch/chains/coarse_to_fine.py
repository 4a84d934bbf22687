"""The coarse-to-fine chain: all facets together, each pass on the surface of the previous one."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path

from torch import nn

from pimper_torch.chains.chain import Chain, Step
from pimper_torch.chains.chain_config import CoarseToFineConfig
from pimper_torch.chains.fusion_memory import largest_problem
from pimper_torch.chains.photometric import Factorizing, Photometric, SweepStage, WarpStage
from pimper_torch.chains.prepare import Prepared
from pimper_torch.chains.running import ChainRun
from pimper_torch.geometry.contours import Contours
from pimper_torch.geometry.pyramids import Sources, build_pyramids
from pimper_torch.lighting.lights import thinned
from pimper_torch.records import (
    Cameras,
    CoarseMesh,
    Mesh,
    OrientedPoints,
    PatchSet,
    PatchViews,
    PhotometricPatches,
    SilhouetteCoverage,
    Silhouettes,
    SparseScene,
    Surface,
    SweptPatches,
)
from pimper_torch.runtime.config import bytes_of
from pimper_torch.runtime.reporting import Observer, stage
from pimper_torch.stages.coarse.remesh import Remesh
from pimper_torch.stages.coarse.surface import CoarseSurface
from pimper_torch.stages.fusion.fuse import Fuse
from pimper_torch.stages.light_depth.depth_from_light import DepthFromLight
from pimper_torch.stages.meshing.extract import Extract
from pimper_torch.stages.meshing.repair import Repair
from pimper_torch.stages.patches.decompose import Decompose
from pimper_torch.stages.patches.warp import Warp
from pimper_torch.stages.photometry.factorize import Factorize
from pimper_torch.stages.photometry.fit_light import FitLight, Illumination
from pimper_torch.stages.photometry.gauge import FixGauge
from pimper_torch.stages.sfm.reconstruct import Reconstruct
from pimper_torch.stages.silhouettes.explain import Explain
from pimper_torch.stages.silhouettes.find import FindSilhouettes
from pimper_torch.stages.silhouettes.trace import TraceContours
from pimper_torch.stages.sweep.sweep import Sweep
from pimper_torch.store import Store, opened


class CoarseToFine(Chain):
    """Chain that fuses and remeshes one surface of the object at every scale."""

    def __init__(
        self,
        config: CoarseToFineConfig | None = None,
        observer: Observer | None = None,
        cache: Store | Path | str | None = None,
        **stages: nn.Module,
    ) -> None:
        self.config = config = config or CoarseToFineConfig()
        store = opened(cache)
        super().__init__(observer, store, config.on_failure)
        self.hold_out = config.hold_out
        self.reconstruct = Reconstruct(config.reconstruct, store)
        self.silhouettes = FindSilhouettes(config.silhouettes)
        self.contours: Callable[[Silhouettes, Cameras], Contours] = TraceContours()
        self.coarse_surface: Callable[..., CoarseMesh] = CoarseSurface(config.coarse_surface)
        self.decompose = Decompose(config.decompose)
        self.warp: WarpStage = Warp(config.warp)
        self.light: Callable[[PatchViews], Illumination] = FitLight(config.light)
        self.depth_from_light: Callable[..., OrientedPoints] = DepthFromLight()
        self.factorize: Factorizing = Factorize(config.factorize)
        self.sweep: SweepStage = Sweep(config.sweep)
        self.photometry: Callable[..., SweptPatches] = Photometric()
        self.gauge: Callable[[PhotometricPatches], PhotometricPatches] = FixGauge(config.factorize)
        self.fuse: Callable[..., Surface] = Fuse(config.fuse)
        self.repair: Callable[[Surface], Surface] = Repair()
        self.remesh: Callable[[SweptPatches, Surface, Contours], CoarseMesh] = Remesh(config.remesh)
        self.explain: Callable[..., SilhouetteCoverage] = Explain()
        self.extract = Extract(config.extract)
        self._swap(stages)

    def first_surface(
        self, run: ChainRun, scene: SparseScene, silhouettes: Silhouettes, mesh: Mesh | None
    ) -> tuple[Contours, CoarseMesh]:
        """Trace the contours and make the coarse surface; see :meth:`Chain.first_surface`."""
        contours = run(self.contours, silhouettes, scene.cameras)
        coarse = run(self.coarse_surface, scene, contours, mesh)
        run(self.explain, coarse.mesh, contours)
        return contours, coarse

    def passes(self, run: ChainRun, prepared: Prepared) -> Iterator[Step]:
        """Run the stages after the coarse mesh once for each scale; see :meth:`Chain.passes`."""
        scene, contours, coarse = prepared.scene, prepared.contours, prepared.coarse
        cameras, surface = scene.cameras, None
        with stage("pyramids"):
            sources = build_pyramids(scene.views, self.config.warp.saturation_level)
        scales = self.config.scales if prepared.patches is None else self.config.scales[-1:]
        for scale, last in run.passes(scales):
            patches = prepared.patches or run(self.decompose, coarse, cameras, surface, scale)
            light = self._light(run, scene, patches, sources)
            if surface is None:
                points = self._swept_points(run, prepared, light)
                if points is not None:
                    coarse = run(self.coarse_surface, scene, contours, None, points)
                    self.show(scene, coarse)
                    patches = run(self.decompose, coarse, cameras, surface, scale)
                    light = self._light(run, scene, patches, sources)
                by_blocks = self._by_blocks(patches)
            each = self.warp, self.factorize, self.sweep
            heights = run(self.photometry, each, scene.views, cameras, patches, light, sources)
            heights = heights.replace(photometric=run(self.gauge, heights.photometric))
            if last:
                del sources  # takes as much memory as the photographs
            surface = run(self.fuse, heights, contours, last, *by_blocks)
            surface = run(self.repair, surface)
            yield Step(scale=scale, last=last, prepared=prepared, heights=heights, surface=surface)
            if not last:
                run(self.explain, surface, contours)
                coarse = run(self.remesh, heights, surface, contours)

    def _light(
        self, run: ChainRun, scene: SparseScene, patches: PatchSet, sources: Sources
    ) -> Illumination:
        """Return the light of every view, from few samples of all patches."""
        seen = run(self.warp, scene.views, scene.cameras, thinned(patches), sources)
        return run(self.light, seen)

    def _swept_points(
        self, run: ChainRun, prepared: Prepared, light: Illumination
    ) -> OrientedPoints | None:
        """Return points where photographs contradict the coarse surface; None if they do not."""
        known = prepared.patches is not None or prepared.mesh is not None
        if known or prepared.scene.views.poses is not None:
            return None
        contours, mesh = prepared.contours, prepared.coarse.mesh
        points = run(self.depth_from_light, prepared.scene, contours, mesh, light.field)
        return points if len(points.points_world) else None

    def _by_blocks(self, patches: PatchSet) -> tuple[float, ...]:
        """Return the number of vertices per linear system of the fusion; empty if all fit."""
        limit, scales = bytes_of(self.config.max_memory), self.config.scales
        size = largest_problem(limit, patches, scales[0], scales[-1])
        return () if math.isinf(size) else (size,)
