"""What a run has found so far: its complete passes, and a picture that shows the last one."""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pimper_torch.chains.chain import Step
from pimper_torch.cli.output import Output
from pimper_torch.records import CoarseMesh, Mesh, SparseScene
from pimper_torch.viz.overview import preview

if TYPE_CHECKING:
    from pimper_torch.viewer.viewer import Viewer


@dataclass(slots=True, kw_only=True)
class Found:
    """Receiver of a chain's records, which draws them and passes them to the viewer.

    Attributes:
        path: The picture, which each record replaces.
        reference: Name of the photograph in the first picture, if it is registered.
        passes: Number of complete passes.
        shown: Whether the path of the picture has been printed.
    """

    output: Output
    path: Path
    viewer: "Viewer | None"
    reference: str
    passes: int = 0
    shown: bool = False

    def coarse(self, scene: SparseScene, coarse: CoarseMesh) -> None:
        """Draw the coarse surface."""
        if self.viewer is not None:
            from pimper_torch.viewer.show import COARSE

            self.viewer.add_pass(COARSE, coarse.mesh)
        self._draw(scene, coarse.mesh, coarse.reference, "coarse surface")

    def record(self, record: SparseScene | Step) -> None:
        """Draw the sparse points, or the surface of a pass."""
        if self.viewer is not None:
            from pimper_torch.viewer.show import add_found

            add_found(self.viewer, record)
        if isinstance(record, Step):
            self.passes += 1
            if not record.last:  # the result is drawn instead
                mesh, reference = record.surface.mesh, record.coarse.reference
                self._draw(record.scene, mesh, reference, f"pass {self.passes}")
        elif len(record.points_world) > 10:  # of fewer, all may be outermost
            names = record.views.names
            spellings = [(name, Path(name).stem) for name in names]
            named = (view for view, each in enumerate(spellings) if self.reference in each)
            self._draw(record, None, next(named, len(names) // 2), "points")

    def _draw(self, scene: SparseScene, mesh: Mesh | None, reference: int, shows: str) -> None:
        with suppress(OSError):  # a full disk does not end the run
            fresh = self.path.with_name(f"{self.path.name}.new")
            preview(scene, mesh, reference).save(fresh, format="PNG")
            fresh.replace(self.path)  # readers find a complete file
            self.output.event("preview", path=self.path, shows=shows)
            if not self.shown:
                self.output.remark(
                    f"{self.output.link(self.path)} shows what is found so far, until the run ends."
                )
            self.shown = True
