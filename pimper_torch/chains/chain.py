"""Base class of both chains: a run is a sequence of steps and the mesh of the last one."""

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from torch import nn

from pimper_torch.chains.running import ChainRun
from pimper_torch.io.assets.mesh_files import MeshFiles
from pimper_torch.kernels.compile import compile_ahead
from pimper_torch.priors.undistort import with_undistorted_priors
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
    Views,
)
from pimper_torch.runtime.config import nearest
from pimper_torch.runtime.errors import ConfigError, InputError, OnFailure
from pimper_torch.runtime.events import Event
from pimper_torch.runtime.failures import failures_of, skipping, warn_of
from pimper_torch.runtime.file_names import view_named
from pimper_torch.runtime.ledger import left_out_of
from pimper_torch.runtime.reporting import Observer, SilentObserver, observed, stage, table_of
from pimper_torch.stages.coarse.depth_points import depth_points
from pimper_torch.stages.coarse.given_mesh import prepared
from pimper_torch.stages.coarse.mesh_frame import refuse_other_axes
from pimper_torch.stages.meshing.finish import Simplify
from pimper_torch.stages.relighting.held_out import Relight, judge_textures
from pimper_torch.stages.sfm.poses import with_poses
from pimper_torch.stages.sfm.sparse_scene import sound
from pimper_torch.stages.sfm.triangulation import FEW_OBSERVED, lacks_points
from pimper_torch.stages.silhouettes.given import AS_THEY_ARE, right_reading
from pimper_torch.stages.stage import Stage, check_handed
from pimper_torch.stages.texturing.bake import Texture
from pimper_torch.store import Store


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Step(Record):
    """All records of one pass over the facets.

    Attributes:
        scale: Scale of the photographs that templates were sampled for; 1 is full size.
        last: Whether this step's surface is the result.
        scene: Cameras, undistorted photographs and the point cloud.
        held_out: Photographs used only to estimate cameras; None without any.
        heights: Depth maps of all patches, with their normals, albedo and lights.
        surface: Joined over all facets, on the subdivided coarse mesh.
        reports: Report of each stage that ran for this step, in order.
        failures: Elements skipped so far because they failed.
        left_out: Elements that guards removed or marked as unreliable so far, in order.
    """

    scale: float
    last: bool
    scene: SparseScene
    silhouettes: Silhouettes
    heights: DepthPatches | SweptPatches
    surface: Surface
    reports: tuple[StageReport, ...] = ()
    failures: tuple[Failure, ...] = ()
    left_out: tuple[Removal, ...] = ()
    held_out: SparseScene | None = None

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
    decompose: Callable[[CoarseMesh, Cameras, Surface | None, float], PatchSet]
    extract: Callable[[Surface], Mesh]

    def __init__(
        self, observer: Observer | None, store: Store | None = None, on_failure: OnFailure = "skip"
    ) -> None:
        super().__init__()
        self.on_failure: OnFailure = on_failure
        self.observer = observer or SilentObserver()
        self.simplify: Callable[[Mesh, MeshFiles], FinishedMesh] = Simplify()
        self.relight: Callable[..., Relighting] = Relight()
        self.texture: Callable[[Mesh, Mesh, Relighting], TexturedMesh] = Texture()
        self.preview: Callable[[SparseScene, CoarseMesh], None] | None = None
        self.watch: Callable[[SparseScene | Step], None] | None = None
        self.needed: tuple[str, ...] = ()
        self.store = store

    @abstractmethod
    def passes(
        self,
        run: ChainRun,
        views: Views | SparseScene,
        sparse_model: Path | str | None,
        mesh: Mesh | None,
    ) -> Iterator[Step]:
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

    def placed(
        self,
        run: ChainRun,
        views: Views | SparseScene,
        sparse_model: Path | str | None,
        mesh: Mesh | None = None,
        *,
        checked: bool = False,
    ) -> SparseScene:
        """Return photographs with their cameras, given or estimated.

        Unusable views are removed, and priors are undistorted. Unless a mesh is given, points are
        added to a scene without observed ones, by the method ``with_points`` of ``reconstruct`` if
        it has one. Masks of other photographs, or rotated or inverted ones, are corrected according
        to cameras and points, and cameras are estimated again, unless masks are ``checked``.
        """
        original = views
        if isinstance(views, Views):
            views = run(self.reconstruct, views, sparse_model)
        elif sparse_model is not None:
            raise InputError(
                f"{type(self).__name__}: cameras are given twice, with the scene and as the model "
                f"in {sparse_model}; needed: one of the two."
            )
        elif mesh is not None:
            refuse_other_axes(mesh, views)
        elif with_points := getattr(self.reconstruct, "with_points", None):
            observed: SparseScene = with_points(views)
            views = observed
        bare = mesh is None and views.cameras.num_views >= 3 and lacks_points(views, FEW_OBSERVED)
        scene = with_poses(sound(run(depth_points, views) if bare else views))
        scene = with_undistorted_priors(scene)
        config = getattr(self.silhouettes, "config", None)
        if not checked and getattr(config, "object", "auto") != "everything":
            photographs = original if isinstance(original, Views) else original.views
            reading = right_reading(scene, photographs)
            if reading is not AS_THEY_ARE:
                views = reading.of(photographs)
                if isinstance(original, SparseScene):
                    views = original.replace(views=views)
                return self.placed(run, views, sparse_model, mesh, checked=True)
        self._notify(scene)
        return scene

    def _notify(self, record: "SparseScene | Step") -> None:
        if self.watch is not None:
            with stage("view"):
                self.watch(record)

    def show(self, scene: SparseScene, coarse: CoarseMesh) -> None:
        """Call ``preview`` with the scene and the coarse surface, if it is set."""
        if self.preview is not None:
            with stage("preview"):
                self.preview(scene, coarse)

    def given_mesh(
        self,
        mesh: Mesh | None,
        views: Views | SparseScene,
        scene: SparseScene,
        silhouettes: Silhouettes,
    ) -> Mesh | None:
        """Return the given mesh in the scene's frame, prepared by :func:`prepared`.

        Args:
            mesh: None is returned unchanged. Given with photographs, in the frame of their cameras'
                model; given with a scene, in its frame.

        Raises:
            InputError: The mesh is not a surface, or is in a different frame.
        """
        if mesh is None:
            return None
        if isinstance(views, Views):
            vertices = mesh.vertices_world.double()
            mesh = mesh.replace(vertices_world=vertices - vertices.new_tensor(scene.offset_world))
        with stage("given_mesh") as report:
            mesh, figures = prepared(mesh, scene, silhouettes)
            report |= figures
        return mesh

    def steps(
        self,
        views: Views | SparseScene,
        sparse_model: Path | str | None = None,
        mesh: Mesh | None = None,
    ) -> Iterator[Step]:
        """Run the stages up to the surface, pass by pass. Arguments are those of :meth:`forward`.

        Yields:
            The records of each finished pass. The next pass runs when it is requested.
        """
        check_handed(self, (views, sparse_model, mesh), {})
        names = (views if isinstance(views, Views) else views.views).names
        for reference in self.references():
            view_named(reference, names)  # an unknown name fails before structure from motion
        passes = self.passes(self.running(), views, sparse_model, mesh)
        compile_ahead()
        entries: list[Event] = []
        while True:
            with skipping(self.on_failure, entries), observed(self.observer) as table:
                step = next(passes, None)
                if step is not None:
                    self._notify(step)
            if step is None:
                return
            if step.last:
                warn_of(entries)
            yield step.replace(
                reports=table_of(table.reports),
                failures=failures_of(entries),
                left_out=left_out_of(entries),
            )

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
            warn_of(entries)
        return Reconstruction(
            mesh=extracted,
            scene=step.scene,
            held_out=step.held_out,
            silhouettes=step.silhouettes,
            coarse=step.coarse,
            patches=step.heights,
            report=table_of([*reports, *table.reports]),
            failures=(*step.failures, *failures_of(entries)),
            left_out=(*step.left_out, *left_out_of(entries)),
        )

    def finish(self, result: Reconstruction, files: MeshFiles | None = None) -> Reconstruction:
        """Prepare a result for export, on the CPU.

        Adds a mesh with fewer vertices, the lights and materials that predict the photographs (the
        held-out ones, if any), and textures for a mesh of few faces.
        """
        result = result.to("cpu")
        scene, held_out, silhouettes = result.scene, result.held_out, result.silhouettes
        run = self.running()
        with skipping(self.on_failure) as entries, observed(self.observer) as table:
            finished = run(self.simplify, result.mesh, files or MeshFiles())
            relighting = run(self.relight, finished.few, scene, silhouettes, held_out)
            asset = run(self.texture, result.mesh, finished.few, relighting)
            # Against the same photographs as the mesh.
            references = (scene, silhouettes) if held_out is None else (held_out, None)
            relighting = run(judge_textures, relighting, asset, *references)
            warn_of(entries)
        return result.replace(
            finished=finished,
            relighting=relighting,
            asset=asset,
            report=table_of([*result.report, *table.reports]),
            failures=(*result.failures, *failures_of(entries)),
            left_out=(*result.left_out, *left_out_of(entries)),
        )

    if TYPE_CHECKING:  # code completion does not resolve the type of a stage's call
        __call__ = forward

    def _swap(self, stages: Mapping[str, nn.Module]) -> None:
        for name, module in stages.items():
            names = [child for child, _ in self.named_children()]
            if name not in names:
                raise ConfigError(
                    f"{type(self).__name__} has no stage `{name}`.{nearest(name, names)} Stages: "
                    f"{', '.join(names)}."
                )
            setattr(self, name, module)
