"""Points that the surface passes through, as terms of its heights.

Each lifts the vertex nearest to where a line through the point, along the direction of heights,
meets the surface. Equations in the three vertices of that face would be right to a further order,
but couple these a thousand times as strongly as slopes do, by entries of the wrong sign for
multigrid.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from pimper_torch.fusion.equations import MIN_FACING, Equations
from pimper_torch.geometry.visibility import Hits, RayCaster
from pimper_torch.records import ContourPoints, FacetPoints, Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Contacts(Record):
    """Points that the surface passes through.

    Attributes:
        points: World.
        lines: Along which they are known, unit.
        variance: Of where they are along these; scene units squared.
    """

    points: Float[Tensor, "point 3"]
    lines: Float[Tensor, "point 3"]
    variance: Float[Tensor, " point"]
    facet: Int[Tensor, " point"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class BaseSurface(Record):
    """The surface that heights are counted from.

    Attributes:
        points: Of the subdivided mesh's vertices now.
        facet: Each vertex lies in.
        directions: ``d``, unit.
        reach: Points further off are not of this surface.
        finest: Least standard error of a point, as the surface is flat between its vertices.
    """

    points: Float[Tensor, "vertex 3"]
    faces: Int[Tensor, "face 3"]
    facet: Int[Tensor, " vertex"]
    heights: Float[Tensor, " vertex"]
    directions: Float[Tensor, "vertex 3"]
    reach: float
    finest: float | Float[Tensor, ""]

    def nearest(self, points: Float[Tensor, "point 3"]) -> Int[Tensor, " point"]:
        """Return the vertex nearest to each point; a constant."""
        tree = cKDTree(self.points.detach().cpu().numpy())
        _, nearest = tree.query(points.detach().cpu().numpy())
        return torch.as_tensor(nearest, device=self.faces.device)


def cloud_points(points: FacetPoints, surface: BaseSurface) -> Contacts:
    """Let the surface pass through points of the cloud; lines are the directions nearest to them.

    Differentiable; which vertex is nearest is constant.
    """
    vertex = surface.nearest(points.points_world)
    line = surface.directions[vertex]
    covariance = points.covariance_world.to(line)
    variance = torch.einsum("pi,pij,pj->p", line, covariance, line)
    return Contacts(
        points=points.points_world.to(line),
        lines=line,
        variance=variance,
        facet=surface.facet[vertex],
    )


def contour_tangents(contours: ContourPoints, surface: BaseSurface) -> Contacts:
    """Let the surface touch the rays through the silhouettes.

    A ray lies in the plane that touches the surface there, so that its position on the ray
    matters little. Where directions run along that plane, heights cannot bring the surface to it.

    Differentiable; where the rays touch, and which vertex is nearest, is constant.
    """
    vertex = surface.nearest(contours.points_world)
    line = surface.directions[vertex]
    facing = (line * contours.normals_world.to(line)).sum(dim=-1)
    usable = facing.detach() > MIN_FACING
    return Contacts(
        points=contours.points_world.to(line)[usable],
        lines=line[usable],
        variance=contours.variance.to(line)[usable] / facing[usable].square(),
        facet=surface.facet[vertex][usable],
    )


def passing(contacts: Contacts, surface: BaseSurface, caster: RayCaster) -> Equations:
    """State that the surface passes through points.

    Differentiable; which face is nearest is constant.
    """
    line = contacts.lines
    hits = _above_or_below(caster, surface, contacts.points, line)
    lift = -hits.distance
    met = (hits.face >= 0) & (lift.abs() <= surface.reach)
    corners, fraction, line = surface.faces[hits.face[met]], hits.barycentric[met], line[met]
    vertex = corners.gather(1, fraction.argmax(dim=1, keepdim=True))
    facing = (surface.directions[vertex[:, 0]] * line).sum(dim=-1).clamp_min(MIN_FACING)
    variance = contacts.variance[met]
    return Equations(
        unknowns=vertex,
        coefficients=torch.ones_like(facing)[:, None],
        targets=surface.heights[vertex[:, 0]] + lift[met] / facing,
        information=1 / variance.clamp_min(surface.finest**2),
        correlated=torch.ones_like(variance),
    )


def _above_or_below(
    caster: RayCaster,
    surface: BaseSurface,
    points: Float[Tensor, "point 3"],
    line: Float[Tensor, "point 3"],
) -> Hits:
    """Find where the line through each point meets the nearer of the faces on both sides."""
    ahead, behind = caster.cast(points, line), caster.cast(points, -line)
    first = ahead.distance <= behind.distance
    nearer = Hits(
        face=torch.where(first, ahead.face, behind.face),
        distance=torch.where(first, ahead.distance, -behind.distance),
        barycentric=torch.where(first[:, None], ahead.barycentric, behind.barycentric),
    )
    return nearer.refined(surface.points, surface.faces, points, line)
