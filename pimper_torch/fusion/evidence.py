r"""What is known of the surface, as linear equations in the heights of the lattice's vertices.

A vertex lies at ``x_v = q_v + h_v d_v``: its place on the flat facet, and the height along its
direction. Every kind of evidence is a set of equations :math:`\sum_k c_k h_{u_k} = t`, each with
the standard deviation that its source claims.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import FacetPoints, Record

# A ray that leaves the surface at a flatter angle than this (cosine) tells no height.
_LEAST_FACING = 0.2


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Evidence(Record):
    """Equations of one kind.

    Attributes:
        unknowns: Vertices that each equation ties together.
        coefficients: Of their heights.
        targets: What these should add up to.
        information: Inverse variance of the target, as its source claims.
        correlated: So many neighbouring equations err alike: what they say together is
            counted once in ``information``, but each errs as little as all of them.
        judged: Whether residuals may tell what the variances are to be multiplied by.
    """

    unknowns: Int[Tensor, "equation term"]
    coefficients: Float[Tensor, "equation term"]
    targets: Float[Tensor, " equation"]
    information: Float[Tensor, " equation"]
    correlated: Float[Tensor, " equation"] | float = 1.0
    judged: bool = True

    def residual(self, heights: Float[Tensor, " vertex"]) -> Float[Tensor, " equation"]:
        """Give what is left: target less sum."""
        return self.targets - (self.coefficients * heights[self.unknowns]).sum(dim=1)


def edges_of(faces: Int[Tensor, "face 3"]) -> Int[Tensor, "edge 2"]:
    """List the edges of a mesh once each."""
    ends = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).sort(dim=1).values
    key = torch.unique(ends[:, 0] * (int(faces.max()) + 1) + ends[:, 1])
    return torch.stack([key // (int(faces.max()) + 1), key % (int(faces.max()) + 1)], dim=1)


def slopes(
    edges: Int[Tensor, "edge 2"],
    flat: Float[Tensor, "vertex 3"],
    directions: Float[Tensor, "vertex 3"],
    normals: Float[Tensor, "vertex 3"],
    variance: Float[Tensor, " vertex"],
    shared: Float[Tensor, " vertex"] | None = None,
) -> Evidence:
    r"""Say that edges are at right angles to the normals at their ends.

    :math:`(n_a + n_b) \cdot (x_b - x_a) = 0`: exact on a parabola. An angle's error moves one
    end by the edge's length times it.

    Args:
        edges: Those whose ends have normals.
        flat: ``q``.
        directions: ``d``, unit.
        normals: Unit, outward.
        variance: Of the normals, squared radians.
        shared: What is added to it so that neighbours that err alike count as what they say
            together; each errs by less.
    """
    one, other = edges.unbind(dim=1)
    middle = normalize(normals[one] + normals[other], dim=-1)
    step = flat[other] - flat[one]
    length = step.norm(dim=-1)
    own = (variance[one] + variance[other]) / 2
    added = torch.zeros_like(own) if shared is None else (shared[one] + shared[other]) / 2
    spread = (own + added) * length.square()
    coefficients = torch.stack(
        [-(middle * directions[one]).sum(dim=-1), (middle * directions[other]).sum(dim=-1)], dim=1
    )
    return Evidence(
        unknowns=edges,
        coefficients=coefficients,
        targets=-(middle * step).sum(dim=-1),
        information=1 / spread,
        correlated=(own + added) / own,
    )


def swept_heights(
    carried: Float[Tensor, " vertex"],
    offsets: Float[Tensor, " vertex"],
    information: Float[Tensor, " vertex"],
    facing: Float[Tensor, " vertex"],
    correlated: float,
) -> Evidence:
    """Say where the sweep has the surface.

    Args:
        carried: Heights of the surface that was swept.
        offsets: Along its normals.
        information: Of the offsets; vertices without any say nothing.
        facing: Cosine between normals and directions.
        correlated: See :class:`Evidence`.
    """
    known = ((information > 0) & (facing > _LEAST_FACING)).nonzero()[:, 0]
    steep = facing[known]
    return Evidence(
        unknowns=known[:, None],
        coefficients=torch.ones_like(steep)[:, None],
        targets=carried[known] + offsets[known] / steep,
        information=information[known] * steep.square(),
        correlated=correlated,
    )


def cloud_points(
    points: FacetPoints,
    surface: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    carried: Float[Tensor, " vertex"],
    directions: Float[Tensor, "vertex 3"],
    reach: float,
) -> Evidence:
    """Say that points of the cloud lie on the surface.

    Each is carried to the face that it lies above or below, along that face's direction.

    Args:
        points: With covariances.
        surface: Where the vertices lie now.
        faces: Of the lattice.
        carried: Heights of the vertices now.
        directions: ``d``.
        reach: Points further off are not of this surface.
    """
    caster = RayCaster(surface, faces)
    places = points.points_world
    corner = directions[faces]
    # The direction of a face near the point's own facet: start from the nearest along any.
    best = None
    for sign in (1.0, -1.0):
        along = sign * normalize(_direction_at(points, directions, faces, surface), dim=-1)
        hits = caster.cast(places, along)
        distance = torch.where(hits.face >= 0, hits.distance, torch.inf)
        if best is None:
            best = (hits.face, hits.barycentric, distance, sign * torch.ones_like(distance), along)
        else:
            nearer = distance < best[2]
            best = (
                torch.where(nearer, hits.face, best[0]),
                torch.where(nearer[:, None], hits.barycentric, best[1]),
                torch.where(nearer, distance, best[2]),
                torch.where(nearer, torch.full_like(distance, sign), best[3]),
                torch.where(nearer[:, None], along, best[4]),
            )
    assert best is not None
    face, barycentric, distance, sign, along = best
    met = (face >= 0) & (distance <= reach)
    face, barycentric = face[met], barycentric[met]
    line = along[met] * sign[met][:, None]
    here = (barycentric[..., None] * corner[face]).sum(dim=1)
    # The surface must move by what separates the point from it, against the way it was cast.
    lift = -sign[met] * distance[met] / (here * line).sum(dim=-1).clamp_min(_LEAST_FACING)
    covariance = points.covariance_world[met].to(line)
    variance = torch.einsum("pi,pij,pj->p", line, covariance, line)
    unknowns = faces[face]
    return Evidence(
        unknowns=unknowns,
        coefficients=barycentric,
        targets=(barycentric * carried[unknowns]).sum(dim=1) + lift,
        information=1 / variance.clamp_min(1e-30),
    )


def _direction_at(
    points: FacetPoints,
    directions: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    surface: Float[Tensor, "vertex 3"],
) -> Float[Tensor, "point 3"]:
    """Give the direction at the vertex nearest to each point."""
    from scipy.spatial import cKDTree

    used = torch.unique(faces)
    _, nearest = cKDTree(surface[used].detach().cpu().numpy()).query(
        points.points_world.detach().cpu().numpy()
    )
    return directions[used[torch.as_tensor(nearest, device=faces.device)]]
