"""The base of both chains: a run is a sequence of steps, and the last one's mesh."""

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from torch import nn

from pimper_torch.ground.geometry.mesh_frame import refuse_other_axes
from pimper_torch.ground.kernels.compile import compile_ahead
from pimper_torch.method.chains.running import Running
from pimper_torch.method.coarse.depth_points import depth_points
from pimper_torch.method.coarse.given_mesh import prepared
from pimper_torch.method.sfm.poses import with_poses
from pimper_torch.method.sfm.sparse_scene import sound
from pimper_torch.method.sfm.triangulation import FEW_OBSERVED, lacks_points
from pimper_torch.method.sfm.undistort import with_undistorted_priors
from pimper_torch.method.silhouettes.given import AS_THEY_ARE, right_reading
from pimper_torch.records import (
    Cameras,
    CoarseMesh,
    DepthPatches,
    Failure,
    Finished,
    LeftOut,
    Mesh,
    PatchSet,
    PhotometricPatches,
    Reconstruction,
    Record,
    Relighting,
    Silhouettes,
    SparseScene,
    StageReport,
    Surface,
    SweptPatches,
    Textured,
    Views,
)
from pimper_torch.result.asset.bake import Texture
from pimper_torch.result.asset.finish import Simplify
from pimper_torch.result.asset.mesh_files import MeshFiles
from pimper_torch.result.relighting.held_out import Relight, judge_textures
from pimper_torch.runtime.config import nearest
from pimper_torch.runtime.errors import ConfigError, InputError, OnFailure
from pimper_torch.runtime.failures import collecting, distinct, warn_of
from pimper_torch.runtime.file_names import view_named
from pimper_torch.runtime.ledger import left_out_of
from pimper_torch.runtime.reporting import Observer, Silent, gathered, recorded, stage
from pimper_torch.runtime.stage import Stage, check_handed
from pimper_torch.runtime.store import Store


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Step(Record):
    """All records of one pass over the facets.

    Attributes:
        scale: Of the photographs that templates were sampled for; 1 is their own size.
        last: Whether this step's surface is the result.
        scene: Cameras, undistorted photographs and the cloud.
        held_out: Photographs that took no part but in finding cameras; None without any.
        heights: Depth maps of all patches, with their normals, albedo and lights.
        surface: Joined over all facets, on the subdivided coarse mesh.
        reports: One of each stage that ran for this step, in order.
        failures: What was left out so far, as it failed.
        left_out: What guards left out or doubted so far, in order.
    """

    scale: float
    last: bool
    scene: SparseScene
    silhouettes: Silhouettes
    heights: DepthPatches | SweptPatches
    surface: Surface
    reports: tuple[StageReport, ...] = ()
    failures: tuple[Failure, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
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

    Each stage is an attribute; assigning a different module that takes and returns the same records
    swaps it, as naming it to the constructor does: ``CoarseToFine(config, factorize=Mine())``.

    Gradients run from photographs, cameras and coarse mesh through every stage after it. Structure
    from motion, how the coarse mesh is found, and what is chosen (views, samples, faces, splits)
    are constants to autograd.

    A function that is assigned to ``preview`` is called with the scene and the coarse surface as
    soon as they are there; one that is assigned to ``watch`` with the scene as soon as cameras are
    known, and with every step that is done. Photographs whose names are in ``needed`` are never
    held out.
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
        self.observer = observer or Silent()
        self.simplify: Callable[[Mesh, MeshFiles], Finished] = Simplify()
        self.relight: Callable[..., Relighting] = Relight()
        self.texture: Callable[[Mesh, Mesh, Relighting], Textured] = Texture()
        self.preview: Callable[[SparseScene, CoarseMesh], None] | None = None
        self.watch: Callable[[SparseScene | Step], None] | None = None
        self.needed: tuple[str, ...] = ()
        self.store = store

    @abstractmethod
    def passes(
        self,
        run: Running,
        views: Views | SparseScene,
        sparse_model: Path | str | None,
        mesh: Mesh | None,
    ) -> Iterator[Step]:
        """Run the stages up to the surface; yield each pass's records, without reports."""

    def running(self) -> Running:
        """Return how stages are called in a run."""
        names = {module: name for name, module in self.named_children()}
        return Running(names=names, store=self.store)

    def references(self) -> Iterator[str]:
        """List the photographs that stages were asked to take for the reference view."""
        for module in self.children():
            named = getattr(getattr(module, "config", None), "reference", "")
            if isinstance(named, str) and named:
                yield named

    def placed(
        self,
        run: Running,
        views: Views | SparseScene,
        sparse_model: Path | str | None,
        mesh: Mesh | None = None,
        *,
        checked: bool = False,
    ) -> SparseScene:
        """Return photographs with their cameras: those that come with them, or else find them.

        Views that cannot be used are left out; priors become those of undistorted views. A scene
        without observed points gets some by the method ``with_points`` of ``reconstruct``, if that
        has one, unless a mesh is given. Masks that belong to
        other photographs, or are turned or inverted, are read as cameras and points say, and
        cameras are found anew with them, unless they are ``checked``.
        """
        asked = views
        if isinstance(views, Views):
            views = run(self.reconstruct, views, sparse_model)
        elif sparse_model is not None:
            raise InputError(
                f"{type(self).__name__}: cameras come twice, with the scene and as the model in "
                f"{sparse_model}; needed: one of the two."
            )
        elif mesh is not None:
            refuse_other_axes(mesh, views)
        elif with_points := getattr(self.reconstruct, "with_points", None):
            observed: SparseScene = with_points(views)
            views = observed
        few = mesh is None and views.cameras.num_views >= 3 and lacks_points(views, FEW_OBSERVED)
        scene = with_poses(sound(run(depth_points, views) if few else views))
        scene = with_undistorted_priors(scene)
        config = getattr(self.silhouettes, "config", None)
        if not checked and getattr(config, "object", "auto") != "everything":
            given = asked if isinstance(asked, Views) else asked.views
            reading = right_reading(scene, given)
            if reading is not AS_THEY_ARE:
                read = reading.of(given)
                asked = read if isinstance(asked, Views) else asked.replace(views=read)
                return self.placed(run, asked, sparse_model, mesh, checked=True)
        self._watched(scene)
        return scene

    def _watched(self, found: "SparseScene | Step") -> None:
        if self.watch is not None:
            with stage("view"):
                self.watch(found)

    def show(self, scene: SparseScene, coarse: CoarseMesh) -> None:
        """Call ``preview`` with cameras and coarse surface, if it is set."""
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
        """Prepare a mesh that came with the photographs, see :func:`prepared`.

        Args:
            mesh: If any. With photographs, in the frame of their cameras' model, with a scene in
                that of the scene.

        Raises:
            InputError: The mesh is not a surface, or is in a different frame.
        """
        if mesh is None:
            return None
        if isinstance(views, Views):
            placed = mesh.vertices_world.double()
            mesh = mesh.replace(vertices_world=placed - placed.new_tensor(scene.offset_world))
        with stage("given_mesh") as told:
            mesh, figures = prepared(mesh, scene, silhouettes)
            told |= figures
        return mesh

    def steps(
        self,
        views: Views | SparseScene,
        sparse_model: Path | str | None = None,
        mesh: Mesh | None = None,
    ) -> Iterator[Step]:
        """Run the stages up to the surface, pass by pass; takes what :meth:`forward` takes.

        Yields:
            The records of a pass, as soon as it is done. The next one runs when it is asked for.
        """
        check_handed(self, (views, sparse_model, mesh), {})
        names = (views if isinstance(views, Views) else views.views).names
        for named in self.references():
            view_named(named, names)  # not first after structure from motion
        passes = self.passes(self.running(), views, sparse_model, mesh)
        compile_ahead()
        entries: list[object] = []
        while True:
            with collecting(self.on_failure, entries), recorded(self.observer) as reports:
                step = next(passes, None)
                if step is not None:
                    self._watched(step)
            if step is None:
                return
            if step.last:
                warn_of(entries)
            yield step.replace(
                reports=tuple(reports), failures=distinct(entries), left_out=left_out_of(entries)
            )

    def forward(
        self,
        views: Views | SparseScene,
        sparse_model: Path | str | None = None,
        mesh: Mesh | None = None,
    ) -> Reconstruction:
        """Reconstruct the surface that the photographs show.

        Args:
            views: Photographs, on the device that everything after structure from motion
                is to run on; or a scene whose cameras are known, see
                :func:`~pimper_torch.doors.io.tensors.scene_of`.
            sparse_model: Folder of a COLMAP model of these photographs, or a file of their cameras,
                used instead of running structure from motion.
            mesh: A rough surface in that model's frame, or in the scene's, of any floating-point
                type, used instead of the photographs' own.

        Raises:
            PimperError: What was found at which stage, what was needed, what to do.
        """
        steps = self.steps(views, sparse_model, mesh)
        step = next(steps)
        reports = list(step.reports)
        while not step.last:
            del step  # the next pass needs its memory
            step = next(steps)
            reports += step.reports
        with collecting(self.on_failure) as entries, recorded(self.observer) as last:
            found = self.running()(self.extract, step.surface)
            warn_of(entries)
        return Reconstruction(
            mesh=found,
            scene=step.scene,
            held_out=step.held_out,
            silhouettes=step.silhouettes,
            coarse=step.coarse,
            patches=step.heights,
            report=gathered([*reports, *last]),
            failures=(*step.failures, *distinct(entries)),
            left_out=(*step.left_out, *left_out_of(entries)),
        )

    def finish(self, result: Reconstruction, files: MeshFiles | None = None) -> Reconstruction:
        """Make a result ready to be written, on the CPU.

        A surface of fewer vertices; the lights and materials under which it predicts its
        photographs, or those that were held out; and textures of few faces.
        """
        result = result.to("cpu")
        scene, held_out, silhouettes = result.scene, result.held_out, result.silhouettes
        run = self.running()
        with collecting(self.on_failure) as entries, recorded(self.observer) as reports:
            finished = run(self.simplify, result.mesh, files or MeshFiles())
            relighting = run(self.relight, finished.few, scene, silhouettes, held_out)
            asset = run(self.texture, result.mesh, finished.few, relighting)
            # By the photographs that the mesh was judged by.
            judged_by = (scene, silhouettes) if held_out is None else (held_out, None)
            relighting = run(judge_textures, relighting, asset, *judged_by)
            warn_of(entries)
        return result.replace(
            finished=finished,
            relighting=relighting,
            asset=asset,
            report=gathered([*result.report, *reports]),
            failures=(*result.failures, *distinct(entries)),
            left_out=(*result.left_out, *left_out_of(entries)),
        )

    if TYPE_CHECKING:  # completion does not see through the type of a stage's call
        __call__ = forward

    def _swap(self, stages: Mapping[str, nn.Module]) -> None:
        for name, module in stages.items():
            known = [known for known, _ in self.named_children()]
            if name not in known:
                raise ConfigError(
                    f"{type(self).__name__} has no stage `{name}`.{nearest(name, known)} Stages: "
                    f"{', '.join(known)}."
                )
            setattr(self, name, module)
