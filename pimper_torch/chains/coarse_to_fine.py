"""The coarse-to-fine chain: all facets together, each pass on the surface of the previous one."""

import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import torch
from torch import nn

from pimper_torch.chains.chain import Chain, Step
from pimper_torch.chains.chain_config import CoarseToFineConfig
from pimper_torch.chains.fusion_memory import largest_problem
from pimper_torch.chains.photometric import Factorizing, Photometric, SweepStage, WarpStage
from pimper_torch.chains.running import ChainRun, called
from pimper_torch.geometry.contours import Contours
from pimper_torch.geometry.pyramids import build_pyramids
from pimper_torch.lighting.lights import thinned
from pimper_torch.priors.conventions import resolve_prior_conventions
from pimper_torch.records import (
    Cameras,
    CoarseMesh,
    Mesh,
    OrientedPoints,
    PatchViews,
    PhotometricPatches,
    Silhouettes,
    SparseScene,
    Surface,
    SweptPatches,
    Views,
)
from pimper_torch.records.scene import with_views
from pimper_torch.runtime.config import bytes_of, require
from pimper_torch.runtime.reporting import Observer
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
from pimper_torch.stages.sfm.poses import one_view_per_pose
from pimper_torch.stages.sfm.reconstruct import Reconstruct
from pimper_torch.stages.silhouettes.explain import explain
from pimper_torch.stages.silhouettes.find import FindSilhouettes, masked, of_all_photographs
from pimper_torch.stages.silhouettes.trace import TraceContours
from pimper_torch.stages.sweep.sweep import Sweep
from pimper_torch.store import Store, opened

# The smallest number from which a surface is reconstructed.
_MIN_VIEWS = 3


def split_held_out(
    scene: SparseScene, every: int, needed: Iterable[str] = ()
) -> tuple[SparseScene, SparseScene | None]:
    """Split a scene into used views and held-out views, which are every n-th in order of names.

    Args:
        needed: Names, with or without suffix, of views that are never held out.

    Returns:
        Scenes with the complete cloud. Without held-out views, the scene itself and None.
    """
    names, stay = scene.views.names, set(needed)
    ordered = sorted(range(len(names)), key=names.__getitem__)
    chosen = ordered[every - 1 :: every] if every else []
    held = [view for view in chosen if not stay & {names[view], names[view].rsplit(".", 1)[0]}]
    if not held:
        return scene, None
    left = len(names) - len(held)
    needs = f"a number that leaves at least {_MIN_VIEWS} views; it leaves {left}"
    require(left >= _MIN_VIEWS, "hold_out", every, needs)
    out = torch.zeros(len(names), dtype=torch.bool)
    out[held] = True
    return (
        with_views(scene, ~out).replace(unregistered=scene.unregistered),
        with_views(scene, out).replace(unregistered=()),
    )


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
        self.gauge: Callable[[PhotometricPatches], PhotometricPatches] = FixGauge(config.factorize)
        self.fuse: Callable[..., Surface] = Fuse(config.fuse)
        self.repair: Callable[[Surface], Surface] = Repair()
        self.remesh: Callable[[SweptPatches, Surface, Contours], CoarseMesh] = Remesh(config.remesh)
        self.extract = Extract(config.extract)
        self._swap(stages)

    def passes(
        self,
        run: ChainRun,
        views: Views | SparseScene,
        sparse_model: Path | str | None,
        mesh: Mesh | None,
    ) -> Iterator[Step]:
        """Run the stages after the coarse mesh once for each scale; see :meth:`Chain.passes`."""
        complete = self.placed(run, views, sparse_model, mesh)
        needed = (*self.references(), *self.needed)
        placed, held_out = split_held_out(complete, self.config.hold_out, needed)
        selected = one_view_per_pose(placed, needed)
        outlines = run(self.silhouettes, selected.scene)
        mesh = self.given_mesh(mesh, views, selected.scene, outlines)
        scene, silhouettes = of_all_photographs(placed, selected, outlines)
        scene = resolve_prior_conventions(scene, silhouettes)
        per_pose = scene if selected.scene is placed else masked(selected.scene, outlines)
        contours = run(self.contours, outlines, per_pose.cameras)
        coarse = run(self.coarse_surface, per_pose, contours, mesh)
        if per_pose is not scene:
            coarse = coarse.replace(reference=int(selected.chosen[coarse.reference]))
        self.show(scene, coarse)
        run(explain, coarse.mesh, contours)
        cameras, surface = scene.cameras, None
        sources = called("prepare", build_pyramids, scene.views, self.config.warp.saturation_level)
        photometric = Photometric(self.warp, self.factorize, self.sweep)
        by_blocks: tuple[float, ...] = ()
        for scale, last in run.passes(self.config.scales):
            patches = run(self.decompose, coarse, cameras, surface, scale)
            seen = run(self.warp, scene.views, cameras, thinned(patches), sources)
            light = run(self.light, seen)
            del seen
            if surface is None and mesh is None and per_pose is scene:
                points = run(self.depth_from_light, scene, contours, coarse.mesh, light.field)
                if len(points.points_world):
                    coarse = run(self.coarse_surface, scene, contours, None, points)
                    self.show(scene, coarse)
                    patches = run(self.decompose, coarse, cameras, surface, scale)
                    seen = run(self.warp, scene.views, cameras, thinned(patches), sources)
                    light = run(self.light, seen)
                    del seen
            if surface is None:
                limit, scales = bytes_of(self.config.max_memory), self.config.scales
                size = largest_problem(limit, patches, scales[0], scales[-1])
                by_blocks = () if math.isinf(size) else (size,)  # vertices per linear system
            heights = run(photometric, scene.views, cameras, patches, light, sources)
            heights = heights.replace(photometric=run(self.gauge, heights.photometric))
            if last:
                del sources  # takes as much memory as the photographs
            surface = run(self.fuse, heights, contours, last, *by_blocks)
            surface = run(self.repair, surface)
            run(explain, surface, contours, per_pose.views.names if mesh is None else ())
            yield Step(
                scale=scale,
                last=last,
                scene=scene,
                held_out=held_out,
                silhouettes=silhouettes,
                heights=heights,
                surface=surface,
            )
            if not last:
                coarse = run(self.remesh, heights, surface, contours)
