"""The whole result of a run, its failures, and estimates of any method to compare it with."""

from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from pimper_torch.records.finished import Finished, Relighting, Textured
from pimper_torch.records.patches import DepthPatches, SweptPatches
from pimper_torch.records.record import Record
from pimper_torch.records.scene import CoarseMesh, Mesh, SparseScene
from pimper_torch.records.silhouettes import Silhouettes
from pimper_torch.records.views import Cameras

What = Literal[
    "photographs", "features", "matches", "points", "pixels", "facets", "faces", "warning"
]


@dataclass(frozen=True, slots=True, kw_only=True)
class Failure(Record):
    """One patch, view, point or solver that failed, while the rest went on.

    Attributes:
        what: ``view``, ``points``, ``patch`` or ``solver``.
        name: Of the view, the system or the work; the facet's number for a patch.
        done: What was done in its place.
    """

    stage: str
    what: str
    name: str
    reason: str
    done: str


@dataclass(frozen=True, slots=True, kw_only=True)
class LeftOut(Record):
    """Items that a guard left out or doubted; see :mod:`pimper_torch.runtime.ledger`.

    Attributes:
        guard: Room and name, such as ``extract.borders``.
        what: Was left out; samples of photographs are pixels.
        names: Of photographs, where they are known.
    """

    guard: str
    what: What
    count: int
    total: int
    reason: str
    names: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class StageReport(Record):
    """Cost and figures of one stage.

    Attributes:
        peak_memory_mb: Highest resident memory of the process up to the stage's end.
        figures: Counts and shares worth telling, such as ``samples`` or ``missing_samples``.
        kept: Whether an earlier run found the record; time and memory are that run's.
    """

    name: str
    seconds: float
    peak_memory_mb: float
    figures: dict[str, int | float]
    kept: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Reconstruction(Record):
    """The surface, and everything that was found on the way.

    Attributes:
        mesh: One connected surface with vertex normals, albedo and confidence.
        scene: Cameras, undistorted photographs and the sparse cloud, in the mesh's frame.
        patches: Relief or swept heights, normals, albedo, confidence and lights of every patch.
        report: One entry a stage, in the order they ran.
        failures: What was left out, as it failed.
        left_out: What guards left out or doubted, in order.
        held_out: Photographs that took no part but in finding cameras, to judge the surface by;
            None without any.
        finished: The surface as it is written; it, lights and materials, and the textured surface
            are there once :meth:`~pimper_torch.method.chains.chain.Chain.finish` made them.
    """

    mesh: Mesh
    scene: SparseScene
    coarse: CoarseMesh
    patches: DepthPatches | SweptPatches
    report: tuple[StageReport, ...]
    silhouettes: Silhouettes
    failures: tuple[Failure, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
    held_out: SparseScene | None = None
    finished: Finished | None = None
    relighting: Relighting | None = None
    asset: Textured | None = None

    @property
    def cameras(self) -> Cameras:
        """The registered views' pinholes."""
        return self.scene.cameras


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Estimate(Record):
    """A method's estimate of an object, in a frame of its own.

    Attributes:
        mesh: The surface; may have no faces if the method gives points only.
        names: Of the views it found cameras for, as the photographs are called.
        cameras: One a name, in the same order; ``None`` if the method gives none.
        lights_world: First-order light of each view, up to one scale; ``None`` if unknown.
        reference: Name of the view the surface was made in, if there is one.
    """

    mesh: Mesh
    names: tuple[str, ...] = ()
    cameras: Cameras | None = None
    lights_world: Float[Tensor, "view 4"] | None = None
    reference: str | None = None
