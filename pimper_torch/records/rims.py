"""What outlines say about the surface: rays that it touches, and where."""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.records.record import Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class RimRays(Record):
    """Rays through the outlines of the object, to which its surface is tangent.

    Attributes:
        view: The view each ray belongs to.
        pixels: Where the outline is, to a fraction of a pixel.
        rays_world: Directions, as long as the ray goes while its depth grows by 1.
        normals_world: Outward unit normal of the surface where it touches the ray: across the
            ray and the outline's tangent.
        sigma_px: Standard deviation of the outline's place, across it.
    """

    view: Int[Tensor, " ray"]
    pixels: Float[Tensor, "ray 2"]
    rays_world: Float[Tensor, "ray 3"]
    normals_world: Float[Tensor, "ray 3"]
    sigma_px: Float[Tensor, " ray"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class RimPoints(Record):
    """Places where the surface touches rim rays.

    Attributes:
        points_world: Where.
        normals_world: Of the surface there, unit, outward.
        variance: Along the normal, scene units squared.
        view: Whose outline each belongs to.
        ray: Index of its ray among the :class:`RimRays`.
    """

    points_world: Float[Tensor, "point 3"]
    normals_world: Float[Tensor, "point 3"]
    variance: Float[Tensor, " point"]
    view: Int[Tensor, " point"]
    ray: Int[Tensor, " point"]
