"""Normals, slopes, areas and neighbourhoods of rasters and meshes."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize


def slopes_from_normals(
    normals: Float[Tensor, "*batch 3"], steepest: float = 10.0
) -> Float[Tensor, "*batch 2"]:
    """Give ``(dz/dx, dz/dy)`` of the depth whose viewer-facing normals these are.

    Slopes are limited to ``steepest`` (about 84 degrees by default), past which a normal
    is as good as on the rim. Differentiable below the limit.
    """
    nz = normals[..., 2:].clamp_max(-1 / steepest)
    return (-normals[..., :2] / nz).clamp(-steepest, steepest)


def normals_from_slopes(slopes: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
    """Undo :func:`slopes_from_normals`: the unit normal with ``n_z < 0``."""
    return normalize(torch.cat([slopes, -torch.ones_like(slopes[..., :1])], dim=-1), dim=-1)


def face_normals(
    vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"]
) -> Float[Tensor, "face 3"]:
    """Give outward normals whose length is twice the area of the face."""
    a, b, c = vertices[faces].unbind(dim=1)
    return torch.linalg.cross(b - a, c - a)


def side_lengths(corners: Float[Tensor, "face 3 dim"]) -> Float[Tensor, "face 3"]:
    """Give the lengths of the faces' sides: from the last corner to the first, then on."""
    return (corners - corners.roll(1, dims=1)).norm(dim=-1)


def vertex_normals(
    vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"]
) -> Float[Tensor, "vertex 3"]:
    """Average the face normals round each vertex by area; unit."""
    per_face = face_normals(vertices, faces)
    total = torch.zeros_like(vertices)
    for corner in range(3):
        total = total.index_add(0, faces[:, corner], per_face)
    return normalize(total, dim=-1)


def face_pairs(faces: Int[Tensor, "face 3"]) -> tuple[Int[Tensor, "pair 2"], Int[Tensor, "pair 2"]]:
    """Find which faces share an edge.

    Returns:
        For every edge with exactly two faces: the faces, and the edge's two vertices.
    """
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).sort(dim=1).values
    if len(edges) == 0:
        return edges, edges
    # One number an edge: sorting rows takes twenty times as long.
    key, order = (edges[:, 0] * (edges.max() + 1) + edges[:, 1]).sort(stable=True)
    new = torch.ones_like(key, dtype=torch.bool)
    new[1:] = key[1:] != key[:-1]
    start = new.nonzero()[:, 0]
    counts = torch.diff(start, append=start.new_tensor([len(key)]))
    first = start[counts == 2]
    return torch.stack([order[first], order[first + 1]], dim=1) // 3, edges[order[first]]


def face_edges(
    faces: Int[Tensor, "face 3"],
) -> tuple[Int[Tensor, "edge 2"], Int[Tensor, "face 3"]]:
    """Give every edge once, its lower vertex first, and which lies opposite to each corner."""
    ends = faces[:, [1, 2, 2, 0, 0, 1]].reshape(-1, 2).sort(dim=1).values
    if len(ends) == 0:
        return ends, faces
    # One number an edge: rows take far longer to compare.
    size = ends.max() + 1
    key, index = torch.unique(ends[:, 0] * size + ends[:, 1], return_inverse=True)
    return torch.stack([key // size, key % size], dim=1), index.reshape(-1, 3)


def boundary_vertices(
    faces: Int[Tensor, "face 3"], num_vertices: int
) -> Bool[Tensor, " {num_vertices}"]:
    """Mark vertices on an edge that has one face, or more than two."""
    edges, index = face_edges(faces)
    border = torch.bincount(index.flatten(), minlength=len(edges)) != 2
    marked = torch.zeros(num_vertices, dtype=torch.bool, device=faces.device)
    marked[edges[border].flatten()] = True
    return marked


def barycentric_2d(
    points: Float[Tensor, "*#batch 2"], corners: Float[Tensor, "*#batch 3 2"]
) -> Float[Tensor, "*batch 3"]:
    """Give barycentric coordinates of points in the plane of triangles."""
    a, b, c = corners.unbind(dim=-2)
    ab, ac, ap = b - a, c - a, points - a
    area = ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0]
    beta = (ap[..., 0] * ac[..., 1] - ap[..., 1] * ac[..., 0]) / area
    gamma = (ab[..., 0] * ap[..., 1] - ab[..., 1] * ap[..., 0]) / area
    return torch.stack([1 - beta - gamma, beta, gamma], dim=-1)


def corners_of(
    faces: Int[Tensor, "face 3"], chosen: Bool[Tensor, " face"], num_vertices: int
) -> Bool[Tensor, " {num_vertices}"]:
    """Mark the vertices of some faces."""
    marked = torch.zeros(num_vertices, dtype=torch.bool, device=faces.device)
    marked[faces[chosen].flatten()] = True
    return marked
