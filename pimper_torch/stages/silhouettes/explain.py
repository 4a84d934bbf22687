"""Coverage of the silhouettes by a surface, per view."""

from collections.abc import Sequence

from pimper_torch.geometry.contours import Contours
from pimper_torch.geometry.coverage import coverage_by
from pimper_torch.records import Mesh, SilhouetteCoverage, Surface
from pimper_torch.runtime.errors import caution
from pimper_torch.stages.stage import Stage


class Explain(Stage):
    """Compare a surface with the silhouettes that it was made from. Not differentiable."""

    def forward(
        self,
        surface: Mesh | Surface,
        contours: Contours,
        names: Sequence[str] = (),
        most: float = 0.1,
    ) -> SilhouetteCoverage:
        """Return the fractions of every silhouette that the surface lacks or exceeds.

        Args:
            names: Of the views, to warn about the worst; no warning by default.
            most: Fraction of a silhouette's area without a warning. The worst views of plain sets
                lack up to 0.08 (potatoes, 12 views along the arc, 320x240, fast), and 0.05 sticks
                out (the demo).
        """
        silhouettes = contours.silhouettes
        if not contours.confine:
            empty = surface.vertices_world.new_zeros(0)
            return SilhouetteCoverage(uncovered=empty, outside=empty)
        found = coverage_by(surface, silhouettes, contours.cameras)
        views = silhouettes.reliable.nonzero()[:, 0].tolist()
        for values, verb in ((found.uncovered, "lacks"), (found.outside, "sticks out by")):
            if names and len(values) and float(values.max()) > most:
                worst = names[views[int(values.argmax())]]
                caution(
                    f"{worst}: the surface {verb} {float(values.max()):.0%} of the silhouette's "
                    f"area; more than {most:.0%} in {int((values > most).sum())} of {len(views)} "
                    "views. Check it in overview.png; `--masks` replaces it.",
                    stacklevel=2,
                )
        return found
