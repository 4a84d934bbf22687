"""Where every view shows the object."""

from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.ground.shapes import Masks, Points
from pimper_torch.records.record import Record
from pimper_torch.records.views import Views
from pimper_torch.runtime.mapped import by_view


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Silhouettes(Record):
    """The object's silhouette in every view.

    Attributes:
        inside: Probability that the pixel's ray meets the object; 0 in the padding. Below a half
            it weighs the view's denial in the visual hull.
        reliable: True for views whose silhouette agrees with the hull of the others.
        source: ``masks`` that a person gave, ``found`` in the photographs, or ``everything``: no
            view constrains the object.
        planes_world: The object is where each has a positive product with ``(x, y, z, 1)``: above
            the plane that it stands on, one for each series between which it was moved. None
            where silhouettes tell, or no plane is known.
        hidden: Pixels inside that show something before the object; ``None`` where none do.
    """

    inside: Float[Tensor, "view height width"]
    reliable: Bool[Tensor, " view"]
    source: Literal["masks", "found", "everything"]
    planes_world: Float[Tensor, "plane 4"] = field(default_factory=lambda: torch.zeros(0, 4))
    hidden: Masks | None = None

    @classmethod
    def everything(
        cls, views: Views, planes_world: Float[Tensor, "plane 4"] | None = None
    ) -> "Silhouettes":
        """Return silhouettes that leave nothing out.

        Args:
            planes_world: What lies below one of them is not the object.
        """
        planes = torch.zeros(0, 4) if planes_world is None else planes_world
        return cls(
            inside=by_view(Tensor.float, views.inside),
            reliable=torch.zeros(views.num_views, dtype=torch.bool, device=views.images.device),
            source="everything",
            planes_world=planes.to(views.images),
        )

    @property
    def shown(self) -> Masks:
        """True where the pixel shows the object itself, not what hides it."""
        if self.hidden is None:
            return self.masks
        return by_view(lambda mask, hidden: mask & ~hidden, self.masks, self.hidden)

    @property
    def masks(self) -> Masks:
        """True where the pixel more likely shows the object than not."""
        return by_view(lambda inside: inside > 0.5, self.inside)


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

    points_world: Points
    normals_world: Points
    variance: Float[Tensor, " point"]
    view: Int[Tensor, " point"]
    ray: Int[Tensor, " point"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class OrientedPoints(Record):
    """Points of surfaces with normals and noise.

    Attributes:
        normals_world: Unit, towards the cameras.
        noise: Standard deviation along the normal, scene units.
    """

    points_world: Points
    normals_world: Points
    noise: Float[Tensor, " point"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SilhouetteCoverage(Record):
    """How a surface differs from silhouettes, in fractions of the area of each.

    Attributes:
        uncovered: Of the silhouette, where the view sees no surface, or its back.
        outside: Of surface beside it, by how sure the silhouette is there.
    """

    uncovered: Float[Tensor, " view"]
    outside: Float[Tensor, " view"]
