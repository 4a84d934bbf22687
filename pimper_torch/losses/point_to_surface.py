"""Distance of a surface to the true one."""

from torch import nn

from pimper_torch.geometry.nearest import NearestSurface
from pimper_torch.records import Mesh, Surface
from pimper_torch.records.shapes import Scalar


class PointToSurfaceLoss(nn.Module):
    """Mean distance of supported vertices to the true surface, in scene units.

    It is the distance to the plane of the nearest face wherever the nearest point is inside a face.
    Differentiable in the vertices: at a nearest point, its own motion does not change the distance.

    Args:
        truth: In the frame of the surface.
    """

    def __init__(self, truth: Mesh) -> None:
        super().__init__()
        self.truth = NearestSurface(truth)

    def forward(self, surface: Surface) -> Scalar:
        """Return the mean distance."""
        points = surface.vertices_world[surface.supported]
        return (points - self.truth.query(points).points).norm(dim=1).mean()
