"""Silhouettes of the object in every view, and the contours they give."""

from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.records.record import Record
from pimper_torch.records.shapes import Masks, PerView, Points
from pimper_torch.records.views import Views
from pimper_torch.runtime.mapped import by_view


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Silhouettes(Record):
    """The object's silhouette in every view.

    Attributes:
        inside: Probability that the pixel's ray meets the object; 0 in the padding. Values below
            0.5 weight the view's exclusion in the visual hull.
        reliable: True for views whose silhouette agrees with the hull of the others.
        source: ``masks`` given by a person, ``found`` in the photographs, or ``everything``: no
            view constrains the object.
        planes_world: The object is where every plane has a positive product with ``(x, y, z, 1)``:
            above the supporting plane, one plane per capture session if the object was moved
            between sessions. Empty if silhouettes suffice or no plane is known.
        hidden: Pixels of the silhouette in which something occludes the object; ``None`` if none.
        expected_overlap: With the truth, as intersection over union; ``None`` if it is not known,
            such as without a supporting plane.
    """

    inside: Float[Tensor, "view height width"]
    reliable: Bool[Tensor, " view"]
    source: Literal["masks", "found", "everything"]
    planes_world: Float[Tensor, "plane 4"] = field(
        default_factory=lambda: torch.zeros(0, 4, dtype=torch.float32, device="cpu")
    )
    hidden: Masks | None = None
    expected_overlap: PerView | None = None

    @classmethod
    def everything(
        cls, views: Views, planes_world: Float[Tensor, "plane 4"] | None = None
    ) -> "Silhouettes":
        """Return silhouettes that exclude nothing.

        Args:
            planes_world: Anything below one of the planes is not the object.
        """
        planes = views.images.new_zeros(0, 4) if planes_world is None else planes_world
        return cls(
            inside=by_view(Tensor.float, views.inside),
            reliable=torch.zeros(views.num_views, dtype=torch.bool, device=views.images.device),
            source="everything",
            planes_world=planes.to(views.images),
        )

    @property
    def shown(self) -> Masks:
        """True where the object itself is visible, not an occluder."""
        if self.hidden is None:
            return self.masks
        return by_view(lambda mask, hidden: mask & ~hidden, self.masks, self.hidden)

    @property
    def masks(self) -> Masks:
        """True where the object is more likely than not."""
        return by_view(lambda inside: inside > 0.5, self.inside)

    def figures(self) -> dict[str, int | float]:
        """Return counts and fractions for the report of the stage."""
        masks, overlap = self.masks, self.expected_overlap
        figures = {} if overlap is None else {"expected_overlap": float(overlap.mean())}
        return figures | {
            "reliable_views": int(self.reliable.sum()),
            "object_fraction": int(masks.count_nonzero()) / max(1, masks.numel()),
        }


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class ContourRays(Record):
    """Rays through the outlines of the object's silhouettes, to which its surface is tangent.

    Attributes:
        pixels: Subpixel positions on the outline.
        rays_world: Directions, scaled to a depth of 1 in the camera.
        normals_world: Outward unit normal of the surface at the tangent point: perpendicular to the
            ray and to the outline's tangent.
        sigma_px: Standard deviation of the outline's position, across it.
    """

    view: Int[Tensor, " ray"]
    pixels: Float[Tensor, "ray 2"]
    rays_world: Float[Tensor, "ray 3"]
    normals_world: Float[Tensor, "ray 3"]
    sigma_px: Float[Tensor, " ray"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class ContourPoints(Record):
    """Points where the surface is tangent to contour rays.

    Attributes:
        normals_world: Of the surface, unit, outward.
        variance: Along the normal, scene units squared.
        view: The view of each point's silhouette.
        ray: Index of each point's ray in :class:`ContourRays`.
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

    def figures(self) -> dict[str, int | float]:
        """Return counts and fractions for the report of the stage."""
        return {"points": len(self.points_world)}


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SilhouetteCoverage(Record):
    """Disagreement of a surface and silhouettes, as fractions of each silhouette's area.

    Attributes:
        uncovered: Part of the silhouette in which the view sees no surface, or its back.
        outside: Area of the surface outside the silhouette, weighted by the silhouette's certainty.
    """

    uncovered: Float[Tensor, " view"]
    outside: Float[Tensor, " view"]

    def figures(self) -> dict[str, int | float]:
        """Return counts and fractions for the report of the stage."""
        if not len(self.uncovered):
            return {}
        return {
            "covered": 1 - float(self.uncovered.mean()),
            "sticking_out": float(self.outside.mean()),
            "least_covered": 1 - float(self.uncovered.max()),
            "most_sticking_out": float(self.outside.max()),
        }
