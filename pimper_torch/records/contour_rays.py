"""Contour rays: rays tangent to the surface at its silhouettes, and the points of tangency."""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.records.record import Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class ContourRays(Record):
    """Rays through the silhouettes of the object, to which its surface is tangent.

    Attributes:
        pixels: Where the silhouette is, to a fraction of a pixel.
        rays_world: Directions, as long as the ray goes while its depth grows by 1.
        normals_world: Outward unit normal of the surface where it touches the ray: across the
            ray and the silhouette's tangent.
        sigma_px: Standard deviation of the silhouette's position, across it.
    """

    view: Int[Tensor, " ray"]
    pixels: Float[Tensor, "ray 2"]
    rays_world: Float[Tensor, "ray 3"]
    normals_world: Float[Tensor, "ray 3"]
    sigma_px: Float[Tensor, " ray"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class ContourPoints(Record):
    """Points where the surface touches contour rays.

    Attributes:
        normals_world: Of the surface there, unit, outward.
        variance: Along the normal, scene units squared.
        view: Whose silhouette each belongs to.
        ray: Index of its ray among the :class:`ContourRays`.
    """

    points_world: Float[Tensor, "point 3"]
    normals_world: Float[Tensor, "point 3"]
    variance: Float[Tensor, " point"]
    view: Int[Tensor, " point"]
    ray: Int[Tensor, " point"]
