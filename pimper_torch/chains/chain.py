"""Base class of both chains: a preparation, a sequence of steps, and the mesh of the last one."""

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import nn

from pimper_torch.chains.prepare import Prepared, prepare
from pimper_torch.chains.running import ChainRun
from pimper_torch.geometry.contours import Contours
from pimper_torch.io.assets.mesh_files import MeshFiles
from pimper_torch.kernels.compile import compile_ahead
from pimper_torch.records import (
    Cameras,
    CoarseMesh,
    DepthPatches,
    Failure,
    FinishedMesh,
    Mesh,
    PatchSet,
    PhotometricPatches,
    Reconstruction,
    Record,
    Relighting,
    Removal,
    Silhouettes,
    SparseScene,
    StageReport,
    Surface,
    SweptPatches,
    TexturedMesh,
    Verdict,
    Views,
)
from pimper_torch.runtime.config import nearest
from pimper_torch.runtime.errors import ConfigError, InputError, OnFailure, caution
from pimper_torch.runtime.events import Event
from pimper_torch.runtime.failures import failures_of, skipping, warn_of
from pimper_torch.runtime.file_names import view_named
from pimper_torch.runtime.ledger import left_out_of
from pimper_torch.runtime.reporting import Observer, SilentObserver, observed, stage, table_of
from pimper_torch.runtime.torch_settings import isolated
from pimper_torch.stages.coarse.depth_points import DepthPoints
from pimper_torch.stages.meshing.finish import Simplify
from pimper_torch.stages.patches.transfer import transfer
from pimper_torch.stages.relighting.held_out import JudgeTextures, Relight
from pimper_torch.stages.stage import Stage, check_handed
from pimper_torch.stages.texturing.bake import Texture
from pimper_torch.stages.verdict.judge import Judge
from pimper_torch.store import Store


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Step(Record):
    """All records of one pass over the facets.

    Attributes:
        scale: Scale of the photographs that templates were sampled for; 1 is full size.
        last: Whether this step's surface is the result.
        prepared: The scene, and all else that was determined before the first pass.
        heights: Depth maps of all patches, with their normals, albedo and lights.
        surface: Joined over all facets, on the subdivided coarse mesh.
        reports: Report of each stage that ran for this step, in order.
        failures: Elements skipped so far because they failed.
        left_out: Elements that guards removed or marked as unreliable so far, in order.
    """

    scale: float
    last: bool
    prepared: Prepared
    heights: DepthPatches | SweptPatches
    surface: Surface
    reports: tuple[StageReport, ...] = ()
    failures: tuple[Failure, ...] = ()
    left_out: tuple[Removal, ...] = ()

    @property
    def scene(self) -> SparseScene:
        """Cameras, undistorted photographs and the point cloud."""
        return self.prepared.scene

    @property
    def silhouettes(self) -> Silhouettes:
        """Of the object, in the photographs of the scene."""
        return self.prepared.silhouettes

    @property
    def held_out(self) -> SparseScene | None:
        """Photographs used only to estimate cameras; ``None`` without any."""
        return self.prepared.held_out

    @isolated
    def frozen(self) -> Prepared:
        """Return what was prepared with the facets and templates of this step's surface.

        Steps from it have the last scale alone. They neither search for facets nor choose the views
        and samples of a template, which takes time and is not differentiable.
        """
        patches = transfer(self.patches.detach(), self.surface.detach().mesh)
        return self.prepared.replace(coarse=patches.coarse, patches=patches)

    @property
    def photometric(self) -> PhotometricPatches:
        """Normals, albedo and lights of every patch."""
        return self.heights.photometric

    @property
    def patches(self) -> PatchSet:
        """The templates."""
        return self.heights.patches

    @property
    def coarse(self) -> CoarseMesh:
        """The facets that carry the templates."""
        return self.heights.patches.coarse


class Chain(Stage):
    """A graph of stages from photographs to a mesh.

    Each stage is an attribute. To replace it, assign a module that takes and returns the same
    records, or pass one to the constructor: ``CoarseToFine(config, factorize=Mine())``.

    Gradients flow from photographs, cameras and coarse mesh through all stages after it. Structure
    from motion, the computation of the coarse mesh, and discrete choices (views, samples, faces,
    splits) are not differentiable.

    The function ``preview`` is called with the scene and the coarse surface as soon as they are
    computed; ``watch`` is called with the scene as soon as cameras are known, and with every
    finished step. Photographs named in ``needed`` are never held out.
    """

    reconstruct: Callable[[Views, Path | str | None], SparseScene]
    silhouettes: Callable[[SparseScene], Silhouettes]
    hold_out: int = 0
    decompose: Callable[[CoarseMesh, Cameras, Surface | None, float], PatchSet]
    extract: Callable[[Surface], Mesh]

    def __init__(
        self, observer: Observer | None, store: Store | None = None, on_failure: OnFailure = "skip"
    ) -> None:
        super().__init__()
        self.on_failure: OnFailure = on_failure
        self.observer = observer or SilentObserver()
        self.depth_points: Callable[[SparseScene], SparseScene] = DepthPoints()
        self.simplify: Callable[[Mesh, MeshFiles], FinishedMesh] = Simplify()
        self.relight: Callable[..., Relighting] = Relight()
        self.texture: Callable[[Mesh, Mesh, Relighting], TexturedMesh] = Texture()
        self.judge_textures: Callable[..., Relighting] = JudgeTextures()
        self.judge: Callable[[Reconstruction], Verdict] = Judge()
        self.preview: Callable[[SparseScene, CoarseMesh], None] | None = None
        self.watch: Callable[[SparseScene | Step], None] | None = None
        self.needed: tuple[str, ...] = ()
        self.store = store

    @abstractmethod
    def first_surface(
        self, run: ChainRun, scene: SparseScene, silhouettes: Silhouettes, mesh: Mesh | None
    ) -> tuple[Contours, CoarseMesh]:
        """Return contours and coarse surface of one photograph per pose.

        Args:
            mesh: A given surface in the scene's frame, used instead of a reconstructed one.
        """

    @abstractmethod
    def passes(self, run: ChainRun, prepared: Prepared) -> Iterator[Step]:
        """Run the stages up to the surface; yield the records of each pass, without reports."""

    def running(self) -> ChainRun:
        """Return the caller of stages for one run."""
        names = {module: name for name, module in self.named_children()}
        return ChainRun(names=names, store=self.store)

    def references(self) -> Iterator[str]:
        """Yield the names of photographs that settings of stages select as reference view."""
        for module in self.children():
            name = getattr(getattr(module, "config", None), "reference", "")
            if isinstance(name, str) and name:
                yield name

    def notify(self, record: "SparseScene | Step") -> None:
        """Call ``watch`` with the scene or a step, if it is set."""
        if self.watch is not None:
            with stage("view"):
                self.watch(record)

    def show(self, scene: SparseScene, coarse: CoarseMesh) -> None:
        """Call ``preview`` with the scene and the coarse surface, if it is set."""
        if self.preview is not None:
            with stage("preview"):
                self.preview(scene, coarse)

    @isolated
    def prepare(
        self,
        views: Views | SparseScene,
        sparse_model: Path | str | None = None,
        mesh: Mesh | None = None,
    ) -> Prepared:
        """Determine cameras, silhouettes, contours and coarse surface, once for many calls.

        :meth:`steps` continues from the result, also from one with other photographs of the same
        sizes: ``prepared.replace(scene=scene.replace(views=views))``. Arguments are those of
        :meth:`forward`.
        """
        check_handed(self, (views, sparse_model, mesh), {})
        names = (views if isinstance(views, Views) else views.views).names
        for reference in self.references():
            view_named(reference, names)  # an unknown name fails before structure from motion
        compile_ahead(gradients=torch.is_grad_enabled())
        with skipping(self.on_failure) as entries, observed(self.observer) as table:
            prepared = prepare(self, self.running(), views, sparse_model, mesh)
            self.show(prepared.scene, prepared.coarse)
        return prepared.replace(
            reports=table_of(table.reports),
            failures=failures_of(entries),
            left_out=left_out_of(entries),
        )

    def steps(
        self,
        views: Views | SparseScene | Prepared,
        sparse_model: Path | str | None = None,
        mesh: Mesh | None = None,
    ) -> Iterator[Step]:
        """Run the stages up to the surface, pass by pass.

        Args:
            views: As for :meth:`forward`; or the result of :meth:`prepare`, without the others.

        Yields:
            The records of each finished pass. The next pass runs when it is requested. Reports of
            the preparation are those of the first pass, too.
        """
        if not isinstance(views, Prepared):
            prepared = self.prepare(views, sparse_model, mesh)
        elif sparse_model is None and mesh is None:
            prepared = views
            prepared.check(f"{type(self).__name__}: prepared")
        else:
            raise InputError(
                f"{type(self).__name__}: cameras or a mesh are given with what was prepared; "
                "needed: give them to `prepare`."
            )
        passes = self.passes(self.running(), prepared)
        next_pass: Callable[[], Step | None] = isolated(partial(next, passes, None))
        entries: list[Event] = [*prepared.failures, *prepared.left_out]
        before = prepared.reports
        while True:
            with skipping(self.on_failure, entries), observed(self.observer) as table:
                step = next_pass()
                if step is not None:
                    self.notify(step)
            if step is None:
                return
            if step.last:
                warn_of(entries)
            yield step.replace(
                reports=table_of([*before, *table.reports]),
                failures=failures_of(entries),
                left_out=left_out_of(entries),
            )
            before = ()

    def forward(
        self,
        views: Views | SparseScene,
        sparse_model: Path | str | None = None,
        mesh: Mesh | None = None,
    ) -> Reconstruction:
        """Reconstruct the surface of the photographed object.

        Args:
            views: Photographs, on the device on which stages after structure from motion run; or
                a scene with known cameras, see :func:`~pimper_torch.io.tensors.scene_of`.
            sparse_model: Folder of a COLMAP model of these photographs, or a file of their cameras,
                used instead of running structure from motion.
            mesh: A rough surface in the frame of that model or of the scene, of any floating-point
                type, used instead of a reconstructed coarse surface.

        Raises:
            PimperError: Names the stage, what it found, what it needs, and what to do.
        """
        steps = self.steps(views, sparse_model, mesh)
        step = next(steps)
        reports = list(step.reports)
        while not step.last:
            del step  # the next pass needs its memory
            step = next(steps)
            reports += step.reports
        with skipping(self.on_failure) as entries, observed(self.observer) as table:
            extracted = self.running()(self.extract, step.surface)
            result = Reconstruction(
                mesh=extracted,
                scene=step.scene,
                held_out=step.held_out,
                silhouettes=step.silhouettes,
                coarse=step.coarse,
                patches=step.heights,
                report=(),
            )
            verdict = self._judged(result, True)
            warn_of(entries)
        return result.replace(
            verdict=verdict,
            report=table_of([*reports, *table.reports]),
            failures=(*step.failures, *failures_of(entries)),
            left_out=(*step.left_out, *left_out_of(entries)),
        )

    @isolated
    def finish(self, result: Reconstruction, files: MeshFiles | None = None) -> Reconstruction:
        """Prepare a result for export, on the CPU.

        Adds a mesh with fewer vertices, the lights and materials that predict the photographs (the
        held-out ones, if any), textures for a mesh of few faces, and the verdict.
        """
        result = result.to("cpu")
        scene, held_out, silhouettes = result.scene, result.held_out, result.silhouettes
        run, files = self.running(), files or MeshFiles()
        shape = MeshFiles(faces=files.faces, watertight=files.watertight)  # others keep the mesh
        with skipping(self.on_failure) as entries, observed(self.observer) as table:
            finished = run(self.simplify, result.mesh, shape)
            relighting = run(self.relight, finished.few, scene, silhouettes, held_out)
            asset = run(self.texture, result.mesh, finished.few, relighting)
            # Against the same photographs as the mesh.
            references = (scene, silhouettes) if held_out is None else (held_out, None)
            relighting = run(self.judge_textures, relighting, asset, *references)
            result = result.replace(finished=finished, relighting=relighting, asset=asset)
            known_good = result.verdict is not None and result.verdict.good
            verdict = self._judged(result, known_good)
            warn_of(entries)
        return result.replace(
            verdict=verdict,
            report=table_of([*result.report, *table.reports]),
            failures=(*result.failures, *failures_of(entries)),
            left_out=(*result.left_out, *left_out_of(entries)),
        )

    if TYPE_CHECKING:  # code completion does not resolve the type of a stage's call
        __call__ = forward

    def _judged(self, result: Reconstruction, warn: bool) -> Verdict:
        """Return the verdict, with a warning if the result is not good."""
        judged = result.replace(finished=None, asset=None, report=(), failures=(), left_out=())
        verdict = self.running()(self.judge, judged)
        if warn and not verdict.good:
            caution(verdict.text, stacklevel=3)
        return verdict

    def _swap(self, stages: Mapping[str, nn.Module]) -> None:
        for name, module in stages.items():
            names = [child for child, _ in self.named_children()]
            if name not in names:
                raise ConfigError(
                    f"{type(self).__name__} has no stage `{name}`.{nearest(name, names)} Stages: "
                    f"{', '.join(names)}."
                )
            setattr(self, name, module)
