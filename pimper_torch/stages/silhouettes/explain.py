"""Coverage of the silhouettes by a surface, per view."""

from pimper_torch.geometry.contours import Contours
from pimper_torch.geometry.coverage import coverage_by
from pimper_torch.records import Mesh, SilhouetteCoverage, Surface
from pimper_torch.stages.stage import Stage


class Explain(Stage):
    """Compare a surface with the silhouettes that it was made from. Not differentiable."""

    def forward(self, surface: Mesh | Surface, contours: Contours) -> SilhouetteCoverage:
        """Return the fractions of every silhouette that the surface lacks or exceeds."""
        return coverage_by(surface, contours.silhouettes, contours.cameras)
