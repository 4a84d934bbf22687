"""Normals, slopes and areas of rasters and meshes."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.records import Mesh
from pimper_torch.records.shapes import FaceMask, Faces, Vectors, Vertices


def slopes_from_normals(normals: Vectors, steepest: float = 10.0) -> Float[Tensor, "*batch 2"]:
    """Return the slopes ``(dz/dx, dz/dy)`` of depth from viewer-facing normals.

    Slopes are limited to ``steepest`` (about 84 degrees by default): steeper normals are nearly at
    the occluding contour. Differentiable below the limit.
    """
    nz = normals[..., 2:].clamp_max(-1 / steepest)
    return (-normals[..., :2] / nz).clamp(-steepest, steepest)


def face_normals(vertices: Vertices, faces: Faces) -> Float[Tensor, "face 3"]:
    """Return outward normals with twice the area of the face as length."""
    a, b, c = vertices[faces].unbind(dim=1)
    return torch.linalg.cross(b - a, c - a)


def unit_face_normals(vertices: Vertices, faces: Faces) -> Float[Tensor, "face 3"]:
    """Return outward unit normals, in any unit of length; zero for a face without area."""
    a, b, c = vertices[faces].unbind(dim=1)
    ab, ac = b - a, c - a
    longest = torch.stack([ab, ac]).detach().abs().amax(dim=(0, 2))
    longest = longest.clamp_min(torch.finfo(vertices.dtype).tiny)
    ab, ac = ab / longest[:, None], ac / longest[:, None]
    return normalize(torch.linalg.cross(ab, ac), dim=1)


def side_lengths(corners: Float[Tensor, "face 3 dim"]) -> Float[Tensor, "face 3"]:
    """Return the lengths of the sides that end at each corner: the first from the last corner."""
    return (corners - corners.roll(1, dims=1)).norm(dim=-1)


def vertex_normals(vertices: Vertices, faces: Faces) -> Vertices:
    """Return unit vertex normals: area-weighted means of the face normals around each vertex."""
    per_face = face_normals(vertices, faces)
    if len(per_face):  # in a large unit, areas are too small to be normalized
        largest = per_face.detach().abs().amax()
        per_face = per_face / largest.clamp_min(torch.finfo(per_face.dtype).tiny)
    total = torch.zeros_like(vertices)
    for corner in range(3):
        total = total.index_add(0, faces[:, corner], per_face)
    return normalize(total, dim=-1)


def component_areas(
    vertices: Vertices, faces: Faces, label: Int[Tensor, " face"], counted: FaceMask | None = None
) -> Float[Tensor, " face"]:
    """Return the area of each face's component, optionally of its counted faces; float64."""
    area = face_normals(vertices, faces).norm(dim=-1).double() / 2
    if counted is not None:
        area = area * counted
    return torch.zeros_like(area).index_add(0, label, area)[label]


def barycentric_2d(
    points: Float[Tensor, "*#batch 2"], corners: Float[Tensor, "*#batch 3 2"]
) -> Vectors:
    """Return barycentric coordinates of points in the plane of triangles."""
    a, b, c = corners.unbind(dim=-2)
    ab, ac, ap = b - a, c - a, points - a
    area = ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0]
    beta = (ap[..., 0] * ac[..., 1] - ap[..., 1] * ac[..., 0]) / area
    gamma = (ab[..., 0] * ap[..., 1] - ab[..., 1] * ap[..., 0]) / area
    return torch.stack([1 - beta - gamma, beta, gamma], dim=-1)


def barycentric(
    points: Float[Tensor, "pair 3"], corners: Float[Tensor, "pair 3 3"]
) -> Float[Tensor, "pair 3"]:
    """Return barycentric coordinates of the perpendicular projections of points onto triangles.

    For a triangle without area they are those of its first corner.
    """
    a, b, c = corners.unbind(dim=1)
    normal = torch.linalg.cross(b - a, c - a)
    square_norm = normal.square().sum(dim=1)
    flat = square_norm == 0
    square_norm = torch.where(flat, 1, square_norm)
    beta = (torch.linalg.cross(points - a, c - a) * normal).sum(dim=1) / square_norm
    gamma = (torch.linalg.cross(b - a, points - a) * normal).sum(dim=1) / square_norm
    weights = torch.stack([1 - beta - gamma, beta, gamma], dim=1)
    return torch.where(flat[:, None], weights.new_tensor([1.0, 0.0, 0.0]), weights)


def carried_normals(mesh: Mesh) -> Vertices:
    """Return a mesh's normals; without normals, the means of adjacent faces' normals."""
    if mesh.normals_world is None:
        return vertex_normals(mesh.vertices_world, mesh.faces)
    return mesh.normals_world
