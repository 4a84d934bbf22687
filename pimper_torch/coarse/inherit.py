"""Normals, points of the cloud and support of a coarse mesh whose facets were split."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.coarse.splitting import Split
from pimper_torch.geometry.surfaces import barycentric_2d, vertex_normals
from pimper_torch.linalg.sparse import SparseCholesky
from pimper_torch.linalg.sums import average
from pimper_torch.records import CoarseMesh, FacetPoints, Mesh, Surface

# Standard error of the normals that a facet blends from those of its corners, and the weight of a
# surface's normals that follow from their neighbours alone, over that of the best: choices.
_MODEL_ERROR_DEG, _MIN_WEIGHT = 8.0, 0.05

# Weight of the facets' own normals in the fit, in fractions of a typical vertex's data: negligible
# except where there is none. A choice.
_DAMPING = 0.01


def normal_weights(information: Float[Tensor, " vertex"]) -> Float[Tensor, " vertex"]:
    """Return inverse variances of normals about those that facets blend, relative to the best.

    Args:
        information: Inverse variance of the normals, one over squared radians.
    """
    known = math.radians(_MODEL_ERROR_DEG) ** 2 * information
    return known / (1 + known) + _MIN_WEIGHT


def fitted_normals(
    mesh: Mesh, surface: Surface, split: Split, index: Int[Tensor, " child"]
) -> Float[Tensor, "vertex 3"]:
    """Fit vertex normals whose blend over the facets is nearest to the surface's normals.

    Least squares over the subdivided mesh, weighted by inverse variances; where that has no
    vertex, the facets' own normals.

    Args:
        index: Of each child among the mesh's faces; -1 for a dropped one.
    """
    vertices, faces = mesh.vertices_world.double(), mesh.faces
    child, barycentric = split.relocate(surface.facet, surface.barycentric)
    face = index[child]
    (kept,) = torch.nonzero(face >= 0, as_tuple=True)
    face, barycentric = face[kept], barycentric[kept].double()
    weight = normal_weights(surface.information[kept].double())[:, None] * barycentric
    normals = surface.normals_world[kept].double()
    # Facet by facet first: a million subdivided mesh vertices are a few thousand blocks.
    zeros = barycentric.new_zeros(len(faces), 3, 3)
    blocks = zeros.index_add(0, face, weight[:, :, None] * barycentric[:, None])
    sums = zeros.index_add(0, face, weight[:, :, None] * normals[:, None])
    diagonal = zeros.new_zeros(len(vertices)).index_add(
        0, faces.flatten(), blocks.diagonal(dim1=1, dim2=2).flatten()
    )
    rhs = torch.zeros_like(vertices).index_add(0, faces.flatten(), sums.flatten(0, 1))
    damping = (_DAMPING * average(diagonal)).clamp_min(1e-12).expand(len(vertices))
    own = vertex_normals(vertices, faces)
    every = torch.arange(len(vertices), device=faces.device)
    fitted = SparseCholesky(
        torch.cat([faces[:, :, None].expand(-1, -1, 3).flatten(), every]),
        torch.cat([faces[:, None].expand(-1, 3, -1).flatten(), every]),
        torch.cat([blocks.flatten(), damping]),
        size=len(vertices),
        what="the coarse mesh's normals",
    ).solve(rhs + damping[:, None] * own)
    facing = (fitted * own).sum(dim=1, keepdim=True) > 0
    return normalize(torch.where(facing, fitted, own), dim=1).to(mesh.vertices_world)


def with_points(
    coarse: CoarseMesh,
    mesh: Mesh,
    split: Split,
    index: Int[Tensor, " child"],
    source: Int[Tensor, " vertex"],
) -> CoarseMesh:
    """Return the new mesh the points of the cloud on its facets, and the support of its facets.

    A vertex that was a point of the cloud and has moved is none any more: the point lies on a
    facet, at its own position with its own covariance.

    Args:
        source: The old vertex that each vertex is or is a copy of; new ones follow the old.
    """
    old, points, covariance = coarse.mesh.vertices_world, coarse.points, coarse.covariance_world
    origin = source.clamp_max(len(old) - 1)
    was_point = (source < len(old)) & coarse.is_point[origin]
    is_point = was_point & (mesh.vertices_world == old[origin]).all(dim=1)
    if points is not None:
        points = _relocated(coarse, points, split, index)
    if covariance is not None:
        (left,) = torch.nonzero(was_point & ~is_point, as_tuple=True)
        once = torch.ones_like(left, dtype=torch.bool)  # a vertex parted in two leaves one point
        once[1:] = origin[left][1:] != origin[left][:-1]
        left = left[once]
        first_face = mesh.faces.new_full((len(source),), len(mesh.faces)).scatter_reduce(
            0,
            mesh.faces.flatten(),
            torch.arange(len(mesh.faces), device=source.device).repeat_interleave(3),
            "amin",
        )
        moved = FacetPoints(
            points_world=old[origin[left]],
            covariance_world=covariance[origin[left]],
            facet=first_face[left],
        )
        points = moved if points is None else FacetPoints.cat([points, moved])
        covariance = torch.where(is_point[:, None, None], covariance[origin], 0)
    return CoarseMesh(
        mesh=mesh,
        reference=coarse.reference,
        is_point=is_point,
        covariance_world=covariance,
        points=points,
        support=None if coarse.support is None else coarse.support[split.parent[index >= 0]],
    )


def _relocated(
    coarse: CoarseMesh, points: FacetPoints, split: Split, index: Int[Tensor, " child"]
) -> FacetPoints:
    """Assign the points on facets to the children that they project into, along the old normal."""
    corners = coarse.mesh.vertices_world[coarse.mesh.faces[points.facet]]
    origin, along = corners[:, 0], corners[:, 1] - corners[:, 0]
    normal = torch.linalg.cross(along, corners[:, 2] - origin)
    x, normal = normalize(along, dim=1), normalize(normal, dim=1)
    axes = torch.stack([x, torch.linalg.cross(normal, x)], dim=2)
    flat = (corners - origin[:, None]) @ axes
    projected = ((points.points_world - origin)[:, None] @ axes)[:, 0]
    child, _ = split.relocate(points.facet, barycentric_2d(projected, flat))
    facet = index[child]
    return points.replace(facet=facet).take(facet >= 0)
