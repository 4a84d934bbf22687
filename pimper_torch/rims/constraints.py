"""What the outlines say about the surface, as one record that stages hand on."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from pimper_torch.outlines.hull import Hull
from pimper_torch.records import Cameras, Record, RimPoints, RimRays
from pimper_torch.rims.touching import rim_points


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Rims(Record):
    """Rays that the surface is tangent to, and the hull that it lies in.

    Attributes:
        rays: Through the outlines of all trusted views.
        cameras: Of all views.
        hull: The visual hull of the same outlines.
    """

    rays: RimRays
    cameras: Cameras
    hull: Hull

    def touching(
        self, points_world: Float[Tensor, "point 3"], normals_world: Float[Tensor, "point 3"]
    ) -> RimPoints:
        """Find where the rays touch a surface; see :func:`~pimper_torch.rims.touching.rim_points`.

        Args:
            points_world: Of the surface: a cloud or a mesh's vertices.
            normals_world: Theirs, unit, outward.
        """
        return rim_points(self.rays, self.cameras, self.hull, points_world, normals_world)
