r"""Linear equations in the heights of vertices, of every kind of the fusion.

A vertex has the position ``x_v = q_v + h_v d_v``: its point on the flat facet, and its height along
its direction. Every kind is a set of equations :math:`\sum_k c_k h_{u_k} = t`, with the variances
stated by its source.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import ContourPoints, FacetPoints, Record
from pimper_torch.records.shapes import (
    Edges,
    Faces,
    PerVertex,
    Points,
    Scalar,
    VertexMask,
    Vertices,
)

# Least cosine between a direction and the normal for data to determine a height.
MIN_FACING = 0.2


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SharedError(Record):
    """An error that neighbours have in common, as their light and albedo were fitted together.

    It does not average out: neighbours with this error agree with each other, and would outvote
    correct data. ``count`` times its variance is added to the variance of each, so that together
    they have the weight of their joint information.

    Attributes:
        count: Number of neighbours that share the error, for each vertex.
    """

    variance: Scalar
    count: PerVertex


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Equations(Record):
    """Equations of one kind.

    Attributes:
        unknowns: Vertices of the heights in each equation; two in those of slopes.
        targets: Right-hand sides.
        information: Inverse variance of the target, as its source states. If neighbours share an
            error, the variance is enlarged, so that their weight together is not too large.
        correlated: Ratio of the enlarged variance to the variance of a single target.
        evaluated: Whether the noise factor is estimated from residuals.
    """

    unknowns: Int[Tensor, "equation term"]
    coefficients: Float[Tensor, "equation term"]
    targets: Float[Tensor, " equation"]
    information: Float[Tensor, " equation"]
    correlated: Float[Tensor, " equation"]
    evaluated: bool = True

    @property
    def is_slope(self) -> bool:
        """Whether the equations are of slopes, and do not determine positions."""
        return self.unknowns.shape[1] == 2

    def residual(self, heights: PerVertex) -> Float[Tensor, " equation"]:
        """Return the residuals, targets minus sums."""
        return self.targets - (self.coefficients * heights[self.unknowns]).sum(dim=1)


def slopes(
    edges: Edges,
    flat: Vertices,
    directions: Vertices,
    normals: Vertices,
    variance: PerVertex,
    common: SharedError | None = None,
) -> Equations:
    r"""Return equations by which edges are perpendicular to the normals at their ends.

    :math:`(n_a + n_b) \cdot (x_b - x_a) = 0`, which is exact on a parabola. An error of the
    angle moves an end by the length of the edge times the error.

    Args:
        edges: Edges with normals at both ends.
        flat: ``q``.
        directions: ``d``, unit.
        normals: Unit, outward.
        variance: Variance of the normals, squared radians.
        common: Tilt that neighbours' normals share.
    """
    start, end = edges.unbind(dim=1)
    centre = normalize(normals[start] + normals[end], dim=-1)
    step = flat[end] - flat[start]
    independent = (variance[start] + variance[end]) / 2
    single, enlarged = independent, independent
    if common is not None:
        single = independent + common.variance
        enlarged = independent + common.variance * (common.count[start] + common.count[end]) / 2
    leaning = torch.stack(
        [-(centre * directions[start]).sum(dim=-1), (centre * directions[end]).sum(dim=-1)], dim=1
    )
    return Equations(
        unknowns=edges,
        coefficients=leaning,
        targets=-(centre * step).sum(dim=-1),
        information=1 / (enlarged * step.square().sum(dim=-1)),
        correlated=enlarged / single,
    )


def upright_edges(edges: Edges, directions: Vertices, normals: Vertices) -> Bool[Tensor, " edge"]:
    """Return the edges whose slope can follow from heights.

    Other edges cross a contour or a fold as seen along the directions: an equal change of height at
    both ends would rotate them. Not differentiable.
    """
    centre = normalize(normals[edges].detach().sum(dim=1), dim=-1)
    return ((centre[:, None] * directions[edges].detach()).sum(dim=-1) > 0.1).all(dim=1)


def kept_slopes(
    edges: Edges,
    flat: Vertices,
    directions: Vertices,
    shape: Vertices,
    transferred: PerVertex,
    variance: PerVertex,
) -> Equations:
    """Return equations by which edges keep the slopes of the current surface.

    Args:
        edges: Edges without normals at both ends.
        variance: Variance of its slopes, squared radians; residuals do not determine it, as they
            start at 0.
    """
    kept = slopes(edges, flat, directions, shape, variance)
    return kept.replace(
        targets=(kept.coefficients * transferred[edges]).sum(dim=1), evaluated=False
    )


def kept_steps(
    edges: Edges, flat: Vertices, transferred: PerVertex, variance: float | Scalar
) -> Equations:
    """Return equations by which edges that are not upright keep their height difference.

    Args:
        transferred: Heights of the current surface.
        variance: Variance of its slopes, squared radians.
    """
    start, end = edges.unbind(dim=1)
    square = (flat[end] - flat[start]).square().sum(dim=-1)
    return Equations(
        unknowns=edges,
        coefficients=flat.new_tensor([-1.0, 1.0]).expand(len(edges), 2),
        targets=transferred[end] - transferred[start],
        information=1 / (variance * square),
        correlated=torch.ones_like(square),
        evaluated=False,
    )


def swept_heights(
    transferred: PerVertex,
    offsets: PerVertex,
    information: PerVertex,
    facing: PerVertex,
    correlated: PerVertex,
    common: SharedError | None = None,
) -> Equations:
    """Return equations by which heights are those of the sweep.

    Args:
        transferred: Heights of the swept surface.
        information: Share of each vertex in the offsets' information; 0 for no equation.
        facing: Cosine between normals and directions.
        correlated: Number of vertices in a window, which share an offset.
        common: Error that neighbours share beyond their windows.
    """
    vertex = upright_heights(information, facing).nonzero()[:, 0]
    cosine = facing[vertex]
    enlarged = 1 / (information[vertex] * cosine.square())
    single = enlarged / correlated[vertex]
    if common is not None:
        single = single + common.variance
        enlarged = enlarged + common.variance * common.count[vertex]
    return Equations(
        unknowns=vertex[:, None],
        coefficients=torch.ones_like(cosine)[:, None],
        targets=transferred[vertex] + offsets[vertex] / cosine,
        information=1 / enlarged,
        correlated=enlarged / single,
    )


def upright_heights(information: PerVertex, facing: PerVertex) -> VertexMask:
    """Return the vertices whose swept offsets determine heights."""
    return (information > 0) & (facing > MIN_FACING)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SurfacePoints(Record):
    """Points that the surface passes through.

    Attributes:
        lines: Unit direction of the line along which each point is known.
        variance: Variance of the position along the line, squared scene units.
    """

    points: Points
    lines: Points
    variance: Float[Tensor, " point"]
    facet: Int[Tensor, " point"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class BaseSurface(Record):
    """The current surface, relative to which contacts become heights.

    Attributes:
        points: Current positions of the subdivision's vertices.
        reach: Maximum distance of points that belong to the surface.
        finest: Least standard error of a point, as the surface is flat between its vertices.
    """

    points: Vertices
    faces: Faces
    facet: Int[Tensor, " vertex"]
    heights: PerVertex
    directions: Vertices
    reach: float
    finest: float | Scalar

    def nearest(self, points: Points) -> Int[Tensor, " point"]:
        """Return the vertex nearest to each point. Not differentiable."""
        tree = cKDTree(self.points.detach().cpu().numpy())
        _, nearest = tree.query(points.detach().cpu().numpy())
        return torch.as_tensor(nearest, device=self.faces.device)


def cloud_points(points: FacetPoints, surface: BaseSurface) -> SurfacePoints:
    """Return contacts with cloud points; differentiable except in the nearest vertex."""
    vertex = surface.nearest(points.points_world)
    line = surface.directions[vertex]
    covariance = points.covariance_world.to(line)
    variance = torch.einsum("pi,pij,pj->p", line, covariance, line)
    return SurfacePoints(
        points=points.points_world.to(line),
        lines=line,
        variance=variance,
        facet=surface.facet[vertex],
    )


def contour_tangents(contours: ContourPoints, surface: BaseSurface) -> SurfacePoints:
    """Return contacts with the rays through the silhouettes.

    A ray is in the tangent plane of its contact, so the position along the ray matters little.
    Contacts where directions are almost parallel to that plane are excluded, as heights cannot move
    the surface to it.

    Differentiable; the position of the contacts on rays, and the nearest vertex, are constant.
    """
    vertex = surface.nearest(contours.points_world)
    line = surface.directions[vertex]
    facing = (line * contours.normals_world.to(line)).sum(dim=-1)
    usable = facing.detach() > MIN_FACING
    return SurfacePoints(
        points=contours.points_world.to(line)[usable],
        lines=line[usable],
        variance=contours.variance.to(line)[usable] / facing[usable].square(),
        facet=surface.facet[vertex][usable],
    )


def passing(contacts: SurfacePoints, surface: BaseSurface, caster: RayCaster) -> Equations:
    """Return equations for the surface to contain points; differentiable, nearest face constant."""
    points, line = contacts.points, contacts.lines
    # Intersection of the line through each point with the nearer of the faces on both sides.
    ahead, behind = caster.cast(points, line), caster.cast(points, -line)
    first = ahead.distance <= behind.distance
    hits = ahead.where(first, behind.replace(distance=-behind.distance))
    hits = hits.refined(surface.points, surface.faces, points, line)
    lift = -hits.distance
    hit = (hits.face >= 0) & (lift.abs() <= surface.reach)
    corners, fraction, line = surface.faces[hits.face[hit]], hits.barycentric[hit], line[hit]
    vertex = corners.gather(1, fraction.argmax(dim=1, keepdim=True))
    facing = (surface.directions[vertex[:, 0]] * line).sum(dim=-1).clamp_min(MIN_FACING)
    variance = contacts.variance[hit]
    return Equations(
        unknowns=vertex,
        coefficients=torch.ones_like(facing)[:, None],
        targets=surface.heights[vertex[:, 0]] + lift[hit] / facing,
        information=1 / variance.clamp_min(surface.finest**2),
        correlated=torch.ones_like(variance),
    )
