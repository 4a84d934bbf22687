"""What goes with the coarse mesh when its facets are split: normals, and the cloud's points."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.coarse.splitting import Split
from pimper_torch.geometry.surfaces import barycentric_2d, vertex_normals
from pimper_torch.linalg.sparse import SparseCholesky
from pimper_torch.records import CoarseMesh, FacetPoints, Mesh, Surface

# The surface's normals count this much where no photograph told them.
UNSURE = 0.05

# How strongly the facets' own normals hold those fitted to the surface, in fractions of a typical
# vertex's data: next to nothing, except where there are none.
_DAMPING = 0.01


def fitted_normals(
    mesh: Mesh, surface: Surface, split: Split, number: Int[Tensor, " child"]
) -> Float[Tensor, "vertex 3"]:
    """Fit normals at the vertices so that, blended over facets, they are the surface's.

    Least squares over the subdivided mesh, weighted by confidence; where there is no subdivided
    mesh the facets' own.

    Args:
        mesh: After splitting and dropping.
        surface: On the mesh before.
        split: From the one to the other.
        number: Of each part among the mesh's faces; -1 for a dropped one.
    """
    vertices, faces = mesh.vertices_world.double(), mesh.faces
    child, place = split.relocate(surface.facet, surface.barycentric)
    face = number[child]
    (on,) = torch.nonzero(face >= 0, as_tuple=True)
    face, place = face[on], place[on].double()
    weight = (surface.confidence[on].double() + UNSURE)[:, None] * place
    normals = surface.normals_world[on].double()
    # Facet by facet first: a million subdivided mesh vertices are a few thousand blocks.
    blocks = place.new_zeros(len(faces), 3, 3)
    blocks.index_add_(0, face, weight[:, :, None] * place[:, None])
    fractions = place.new_zeros(len(faces), 3, 3)
    fractions.index_add_(0, face, weight[:, :, None] * normals[:, None])
    like = place.new_zeros(len(vertices))
    diagonal = like.index_add(0, faces.flatten(), blocks.diagonal(dim1=1, dim2=2).flatten())
    rhs = torch.zeros_like(vertices).index_add(0, faces.flatten(), fractions.flatten(0, 1))
    damping = (_DAMPING * diagonal.mean()).clamp_min(1e-12).expand(len(vertices))
    own = vertex_normals(vertices, faces)
    everyone = torch.arange(len(vertices), device=faces.device)
    fitted = SparseCholesky(
        torch.cat([faces[:, :, None].expand(-1, -1, 3).flatten(), everyone]),
        torch.cat([faces[:, None].expand(-1, 3, -1).flatten(), everyone]),
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
    number: Int[Tensor, " child"],
    source: Int[Tensor, " vertex"],
) -> CoarseMesh:
    """Put the mesh beside the cloud's points: those on facets, and those that vertices left.

    Args:
        coarse: Before.
        mesh: After.
        split: From the one to the other.
        number: Of each part among the mesh's faces; -1 for a dropped one.
        source: The vertex each one is or is a copy of; new ones follow the old.
    """
    old, points = coarse.mesh.vertices_world, coarse.points
    origin = source.clamp_max(len(old) - 1)
    was_point = (source < len(old)) & coarse.is_point[origin]
    stayed = (mesh.vertices_world == old[origin]).all(dim=1)
    if points is not None:
        points = _transferred(coarse, points, split, number)
    covariance = coarse.covariance_world
    if covariance is not None:
        (left,) = torch.nonzero(was_point & ~stayed, as_tuple=True)
        once = torch.ones_like(left, dtype=torch.bool)  # a vertex parted in two leaves one point
        once[1:] = origin[left][1:] != origin[left][:-1]
        left = left[once]
        points = _joined(
            points,
            FacetPoints(
                points_world=old[origin[left]],
                covariance_world=covariance[origin[left]],
                facet=_first_face(mesh.faces, len(source))[left],
            ),
        )
        covariance = torch.where((was_point & stayed)[:, None, None], covariance[origin], 0)
    return CoarseMesh(
        mesh=mesh,
        reference=coarse.reference,
        is_point=was_point & stayed,
        covariance_world=covariance,
        points=points,
        support=None if coarse.support is None else coarse.support[split.parent[number >= 0]],
    )


def _transferred(
    coarse: CoarseMesh, points: FacetPoints, split: Split, number: Int[Tensor, " child"]
) -> FacetPoints:
    """Give the points on facets to the parts they lie over, straight down on the old plane."""
    corners = coarse.mesh.vertices_world[coarse.mesh.faces[points.facet]]
    origin, along = corners[:, 0], corners[:, 1] - corners[:, 0]
    normal = torch.linalg.cross(along, corners[:, 2] - origin)
    x, normal = normalize(along, dim=1), normalize(normal, dim=1)
    axes = torch.stack([x, torch.linalg.cross(normal, x)], dim=2)
    flat = (corners - origin[:, None]) @ axes
    place = ((points.points_world - origin)[:, None] @ axes)[:, 0]
    child, _ = split.relocate(points.facet, barycentric_2d(place, flat))
    facet = number[child]
    (on,) = torch.nonzero(facet >= 0, as_tuple=True)
    return FacetPoints(
        points_world=points.points_world[on],
        covariance_world=points.covariance_world[on],
        facet=facet[on],
    )


def _joined(one: FacetPoints | None, other: FacetPoints) -> FacetPoints:
    return other if one is None else FacetPoints.cat([one, other])


def _first_face(faces: Int[Tensor, "face 3"], count: int) -> Int[Tensor, " {count}"]:
    """Give the first face round each vertex."""
    face = torch.arange(len(faces), device=faces.device).repeat_interleave(3)
    unset = torch.full((count,), len(faces), device=faces.device)
    return unset.scatter_reduce(0, faces.flatten(), face, "amin")
