"""The complete result of a run, its failures, and estimates of other methods for comparison."""

from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from pimper_torch.records.finished import FinishedMesh, Relighting, TexturedMesh
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
    """One patch, view, point or solver that failed while the run continued.

    Attributes:
        what: ``view``, ``points``, ``patch`` or ``solver``.
        name: Name of the view, system or task; the facet's number for a patch.
        done: What was done instead.
    """

    stage: str
    what: str
    name: str
    reason: str
    done: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Removal(Record):
    """Items that a guard removed or reported; see :mod:`pimper_torch.runtime.ledger`.

    Attributes:
        guard: Stage and name, such as ``extract.borders``.
        what: Kind of the items; samples of photographs are pixels.
        names: Names of the photographs, if known.
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
        figures: Counts and fractions, such as ``samples`` or ``missing_samples``.
        kept: Whether the record is an earlier run's; time and memory are then that run's.
    """

    name: str
    seconds: float
    peak_memory_mb: float
    figures: dict[str, int | float]
    kept: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Reconstruction(Record):
    """The surface and all intermediate results.

    Attributes:
        mesh: One connected surface with vertex normals, albedo and confidence.
        scene: Cameras, undistorted photographs and the sparse cloud, in the mesh's frame.
        patches: Relief or swept heights, normals, albedo, confidence and lights of every patch.
        report: One entry per stage, in the order they ran.
        failures: Items that failed and were skipped.
        left_out: Items that guards removed or reported, in order.
        held_out: Photographs for evaluation, used only to estimate cameras; ``None`` without any.
        finished: The surface as written. ``finished``, ``relighting`` and ``asset`` are ``None``
            until :meth:`~pimper_torch.method.chains.chain.Chain.finish` has made them.
    """

    mesh: Mesh
    scene: SparseScene
    coarse: CoarseMesh
    patches: DepthPatches | SweptPatches
    report: tuple[StageReport, ...]
    silhouettes: Silhouettes
    failures: tuple[Failure, ...] = ()
    left_out: tuple[Removal, ...] = ()
    held_out: SparseScene | None = None
    finished: FinishedMesh | None = None
    relighting: Relighting | None = None
    asset: TexturedMesh | None = None

    @property
    def cameras(self) -> Cameras:
        """Pinhole cameras of the registered views."""
        return self.scene.cameras


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Estimate(Record):
    """A method's estimate of an object, in an arbitrary frame.

    Attributes:
        mesh: The surface; may have no faces if the method gives only points.
        names: Names of the photographs that have cameras.
        cameras: One per name, in the same order; ``None`` if the method gives none.
        lights_world: First-order light of each view, up to one scale; ``None`` if unknown.
        reference: Name of the view in which the surface was estimated, if any.
    """

    mesh: Mesh
    names: tuple[str, ...] = ()
    cameras: Cameras | None = None
    lights_world: Float[Tensor, "view 4"] | None = None
    reference: str | None = None
