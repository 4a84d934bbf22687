"""The complete result of a run."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pimper_torch.records.finished import FinishedMesh, Relighting, TexturedMesh, Verdict
from pimper_torch.records.heights import DepthPatches, SweptPatches
from pimper_torch.records.record import Record
from pimper_torch.records.scene import CoarseMesh, Mesh, SparseScene
from pimper_torch.records.silhouettes import Silhouettes
from pimper_torch.records.views import Cameras
from pimper_torch.runtime.events import Failure, Removal, StageReport
from pimper_torch.runtime.later import later

if TYPE_CHECKING:
    from PIL.Image import Image


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
            until :meth:`~pimper_torch.chains.chain.Chain.finish` has made them.
        verdict: Whether it is good; with the prediction of photographs after ``finish``.
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
    verdict: Verdict | None = None

    @property
    def cameras(self) -> Cameras:
        """Pinhole cameras of the registered views."""
        return self.scene.cameras

    def plot(self) -> "Image":
        """Draw the contact sheet of a run; see :func:`~pimper_torch.viz.overview.overview`."""
        image: Image = later("viz.overview.overview")(self)
        return image
