"""Places that the surface passes through, as evidence for its heights.

Each lifts the surface where it lies above or below it along the nearest vertex's direction, and
with it the vertex next to that place. To share it out among three vertices would be right to a
further order; but it would tie these a thousand times as strongly as slopes do, by entries of the
wrong sign for multigrid.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from pimper_torch.fusion.terms import MIN_FACING, Terms
from pimper_torch.geometry.visibility import Hits, RayCaster
from pimper_torch.records import ContourPoints, FacetPoints, Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Contacts(Record):
    """Places that the surface passes through.

    Attributes:
        places: World.
        lines: Along which they are known, unit.
        variance: Of where they are along these; scene units squared.
    """

    places: Float[Tensor, "place 3"]
    lines: Float[Tensor, "place 3"]
    variance: Float[Tensor, " place"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Ground(Record):
    """The surface that heights are counted from.

    Attributes:
        places: Of the subdivided mesh's vertices now.
        faces: Of the subdivided mesh.
        heights: Of the vertices now.
        directions: ``d``, unit.
        reach: Places further off are not of this surface.
        finest: Deviation that the surest place has, of the surface between its vertices.
    """

    places: Float[Tensor, "vertex 3"]
    faces: Int[Tensor, "face 3"]
    heights: Float[Tensor, " vertex"]
    directions: Float[Tensor, "vertex 3"]
    reach: float
    finest: float | Float[Tensor, ""]

    def lines_at(self, places: Float[Tensor, "place 3"]) -> Float[Tensor, "place 3"]:
        """Give the direction of the vertex nearest to each place; which that is is constant."""
        tree = cKDTree(self.places.detach().cpu().numpy())
        _, nearest = tree.query(places.detach().cpu().numpy())
        return self.directions[torch.as_tensor(nearest, device=self.faces.device)]


def cloud_points(points: FacetPoints, ground: Ground) -> Contacts:
    """Let the surface pass through points of the cloud; lines are the directions nearest to them.

    Differentiable; which vertex is nearest is constant.
    """
    line = ground.lines_at(points.points_world)
    covariance = points.covariance_world.to(line)
    variance = torch.einsum("pi,pij,pj->p", line, covariance, line)
    return Contacts(places=points.points_world.to(line), lines=line, variance=variance)


def contour_tangents(contours: ContourPoints, ground: Ground) -> Contacts:
    """Let the surface touch the rays through the silhouettes.

    A ray lies in the plane that touches the surface there, so that where on the ray the place is
    matters little. Where directions run along that plane, heights cannot bring the surface to it.

    Differentiable; where the rays touch, and which vertex is nearest, is constant.
    """
    line = ground.lines_at(contours.points_world)
    facing = (line * contours.normals_world.to(line)).sum(dim=-1)
    told = facing.detach() > MIN_FACING
    return Contacts(
        places=contours.points_world.to(line)[told],
        lines=line[told],
        variance=contours.variance.to(line)[told] / facing[told].square(),
    )


def passing(contacts: Sequence[Contacts], ground: Ground) -> list[Terms]:
    """Say that the surface passes through places, kind by kind.

    Differentiable; which face is nearest is constant.
    """
    caster = RayCaster(ground.places, ground.faces) if contacts else None
    return [_passing(each, ground, caster) for each in contacts if caster is not None]


def _passing(contacts: Contacts, ground: Ground, caster: RayCaster) -> Terms:
    line = contacts.lines
    hits = _above_or_below(caster, ground, contacts.places, line)
    lift = -hits.distance
    met = (hits.face >= 0) & (lift.abs() <= ground.reach)
    corners, fraction, line = ground.faces[hits.face[met]], hits.barycentric[met], line[met]
    vertex = corners.gather(1, fraction.argmax(dim=1, keepdim=True))
    facing = (ground.directions[vertex[:, 0]] * line).sum(dim=-1).clamp_min(MIN_FACING)
    variance = contacts.variance[met]
    return Terms(
        unknowns=vertex,
        coefficients=torch.ones_like(facing)[:, None],
        targets=ground.heights[vertex[:, 0]] + lift[met] / facing,
        information=1 / variance.clamp_min(ground.finest**2),
        correlated=torch.ones_like(variance),
    )


def _above_or_below(
    caster: RayCaster,
    ground: Ground,
    places: Float[Tensor, "point 3"],
    line: Float[Tensor, "point 3"],
) -> Hits:
    """Find where the line through each place meets the nearer of the faces on both sides."""
    ahead, behind = caster.cast(places, line), caster.cast(places, -line)
    first = ahead.distance <= behind.distance
    nearer = Hits(
        face=torch.where(first, ahead.face, behind.face),
        distance=torch.where(first, ahead.distance, -behind.distance),
        barycentric=torch.where(first[:, None], ahead.barycentric, behind.barycentric),
    )
    return nearer.refined(ground.places, ground.faces, places, line)
