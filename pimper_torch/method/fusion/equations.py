r"""Linear equations in the heights of vertices, of every kind that the fusion knows.

A vertex lies at ``x_v = q_v + h_v d_v``: its position on the flat facet, and the height along its
direction. Every kind is a set of equations :math:`\sum_k c_k h_{u_k} = t`, each with
the variance that its source claims.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.ground.geometry.visibility import Hits, RayCaster
from pimper_torch.ground.shapes import Edges, Faces, PerVertex, Points, Scalar, VertexMask, Vertices
from pimper_torch.records import ContourPoints, FacetPoints, Record

# A direction that leaves the surface at a flatter angle than this (cosine) tells no height.
MIN_FACING = 0.2


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SharedError(Record):
    """An error that neighbours have in common, as their light and albedo were found together.

    It does not average out. Neighbours that have it agree with each other, and would outvote
    what is right; ``count`` times its variance, added to that of each, makes all of them
    together count for what they know.

    Attributes:
        count: Of the neighbours that have it, for each vertex.
    """

    variance: Scalar
    count: PerVertex


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Equations(Record):
    """Equations of one kind.

    Attributes:
        unknowns: Vertices that each equation ties together.
        targets: What these should add up to.
        information: Inverse variance of the target, as its source claims, or what is left of it
            where neighbours have a common error: together they must not count for more.
        correlated: How many times less than the variance so enlarged each target errs by.
        evaluated: Whether the noise factor is estimated from residuals.
    """

    unknowns: Int[Tensor, "equation term"]
    coefficients: Float[Tensor, "equation term"]
    targets: Float[Tensor, " equation"]
    information: Float[Tensor, " equation"]
    correlated: Float[Tensor, " equation"]
    evaluated: bool = True

    def residual(self, heights: PerVertex) -> Float[Tensor, " equation"]:
        """Return the residual: target less sum."""
        return self.targets - (self.coefficients * heights[self.unknowns]).sum(dim=1)


def slopes(
    edges: Edges,
    flat: Vertices,
    directions: Vertices,
    normals: Vertices,
    variance: PerVertex,
    common: SharedError | None = None,
) -> Equations:
    r"""State that edges are at right angles to the normals at their ends.

    :math:`(n_a + n_b) \cdot (x_b - x_a) = 0`, which is exact on a parabola. An error of the
    angle moves one end by the edge's length times it.

    Args:
        edges: Those whose ends have normals.
        flat: ``q``.
        directions: ``d``, unit.
        normals: Unit, outward.
        variance: Of the normals, squared radians.
        common: Tilt that neighbours' normals have in common.
    """
    one, other = edges.unbind(dim=1)
    centre = normalize(normals[one] + normals[other], dim=-1)
    step = flat[other] - flat[one]
    own = (variance[one] + variance[other]) / 2
    each, together = own, own
    if common is not None:
        each = own + common.variance
        together = own + common.variance * (common.count[one] + common.count[other]) / 2
    leaning = torch.stack(
        [-(centre * directions[one]).sum(dim=-1), (centre * directions[other]).sum(dim=-1)], dim=1
    )
    return Equations(
        unknowns=edges,
        coefficients=leaning,
        targets=-(centre * step).sum(dim=-1),
        information=1 / (together * step.square().sum(dim=-1)),
        correlated=together / each,
    )


def upright(edges: Edges, directions: Vertices, normals: Vertices) -> Bool[Tensor, " edge"]:
    """Find edges whose slope heights can follow.

    Others lie across a contour or a fold as seen along the directions: raising both ends by the
    same height would rotate the edge. Constant.
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
    """State that edges keep the slopes of the present surface, where light determines none.

    Args:
        edges: Those without normals at both ends.
        variance: Of its slopes, squared radians; no residual shows it, for they start at 0.
    """
    found = slopes(edges, flat, directions, shape, variance)
    return found.replace(
        targets=(found.coefficients * transferred[edges]).sum(dim=1), evaluated=False
    )


def kept_steps(
    edges: Edges, flat: Vertices, transferred: PerVertex, variance: float | Scalar
) -> Equations:
    """State that heights go on differing as they do, where edges are not upright.

    Args:
        transferred: Heights of the surface that there is.
        variance: Of its slopes, squared radians.
    """
    one, other = edges.unbind(dim=1)
    square = (flat[other] - flat[one]).square().sum(dim=-1)
    return Equations(
        unknowns=edges,
        coefficients=flat.new_tensor([-1.0, 1.0]).expand(len(edges), 2),
        targets=transferred[other] - transferred[one],
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
    """State where the sweep has the surface.

    Args:
        transferred: Heights of the surface that was swept.
        information: Of the offsets, each vertex's own share; one without says nothing.
        facing: Cosine between normals and directions.
        correlated: Vertices in a window, which have one offset.
        common: Error that neighbours have in common, beyond their windows.
    """
    known = upright_heights(information, facing).nonzero()[:, 0]
    steep = facing[known]
    together = 1 / (information[known] * steep.square())
    each = together / correlated[known]
    if common is not None:
        each = each + common.variance
        together = together + common.variance * common.count[known]
    return Equations(
        unknowns=known[:, None],
        coefficients=torch.ones_like(steep)[:, None],
        targets=transferred[known] + offsets[known] / steep,
        information=1 / together,
        correlated=together / each,
    )


def upright_heights(information: PerVertex, facing: PerVertex) -> VertexMask:
    """Find vertices whose swept offsets determine heights."""
    return (information > 0) & (facing > MIN_FACING)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Contacts(Record):
    """Points that the surface passes through.

    Attributes:
        lines: Along which they are known, unit.
        variance: Of where they are along these; scene units squared.
    """

    points: Points
    lines: Points
    variance: Float[Tensor, " point"]
    facet: Int[Tensor, " point"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class BaseSurface(Record):
    """The surface that heights are counted from.

    Attributes:
        points: Of the subdivided mesh's vertices now.
        reach: Points further off are not of this surface.
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
    points, line = contacts.points, contacts.lines
    # Where the line through each point meets the nearer of the faces on both sides.
    ahead, behind = caster.cast(points, line), caster.cast(points, -line)
    first = ahead.distance <= behind.distance
    hits = Hits(
        face=torch.where(first, ahead.face, behind.face),
        distance=torch.where(first, ahead.distance, -behind.distance),
        barycentric=torch.where(first[:, None], ahead.barycentric, behind.barycentric),
    ).refined(surface.points, surface.faces, points, line)
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
