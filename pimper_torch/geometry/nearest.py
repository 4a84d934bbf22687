"""Nearest points on a surface.

The only module that calls fcpw, which searches on the CPU in float32 whatever the device of the
tensors. The distance to the face found is then computed in float64. Not differentiable.
"""

from dataclasses import dataclass

import fcpw
import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from pimper_torch.records import Mesh, Record
from pimper_torch.records.shapes import Points
from pimper_torch.runtime.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class NearestPoints(Record):
    """Nearest points on a surface.

    Attributes:
        face: Index of the face that contains each; for a point cloud, of the point.
    """

    distance: Float[Tensor, " point"]
    points: Points
    face: Int[Tensor, " point"]


class NearestSurface:
    """A mesh prepared for nearest-point queries; without faces, a point cloud.

    Degenerate faces count as the edges or points they have shrunk to. Vertices without a face are
    not part of a mesh with faces. If distances of faces differ by less than a millionth of the
    extent of mesh and points, any of these faces may be returned.

    >>> square = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    >>> mesh = Mesh(vertices_world=square, faces=torch.tensor([[0, 1, 2], [0, 2, 3]]))
    >>> NearestSurface(mesh).query(torch.tensor([[0.5, 0.25, 2.0], [1.5, 0.5, 0.0]])).distance
    tensor([2.0000, 0.5000])
    """

    def __init__(self, mesh: Mesh) -> None:
        self._vertices = mesh.vertices_world.detach().cpu().double()
        self._faces = mesh.faces.cpu()
        if len(self._vertices) == 0:
            raise InputError("the surface has no vertices; needed: a mesh or a point cloud.")
        if len(self._faces) == 0:
            self._tree = cKDTree(self._vertices.numpy())
            return
        used = self._vertices[torch.unique(self._faces)]
        # Float32 is finest around the origin.
        self._origin = (used.amin(dim=0) + used.amax(dim=0)) / 2
        self._scene = fcpw.scene_3D()
        self._scene.set_object_count(1)
        self._scene.set_object_vertices(self._columns(self._vertices), 0)
        self._scene.set_object_triangles(np.asfortranarray(self._faces.int().numpy()), 0)
        self._scene.build(fcpw.aggregate_type.bvh_surface_area, True)

    def query(self, points: Points) -> NearestPoints:
        """Return the nearest point of the surface for every point."""
        queries = points.detach().cpu().double()
        if len(self._faces):
            hits = fcpw.interaction_3D_list()
            unlimited = np.full(len(queries), np.inf, dtype=np.float32)
            self._scene.find_closest_points(self._columns(queries), unlimited, hits)
            face = torch.from_numpy(np.array([hit.primitive_index for hit in hits], dtype=np.int64))
            nearest = closest_on_triangles(queries, self._vertices[self._faces[face]])
        else:
            face = torch.from_numpy(np.asarray(self._tree.query(queries.numpy())[1])).long()
            nearest = self._vertices[face]
        return NearestPoints(
            distance=(queries - nearest).norm(dim=1).to(points),
            points=nearest.to(points),
            face=face.to(points.device),
        )

    def _columns(self, points: Points) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
        return np.asfortranarray((points - self._origin).float().numpy())


def closest_on_triangles(
    points: Float[Tensor, "pair 3"], corners: Float[Tensor, "pair 3 3"]
) -> Float[Tensor, "pair 3"]:
    """Return the point of each triangle nearest to its point of ``points``.

    It is the foot of the perpendicular if that is inside, else the nearest point of the edges. A
    degenerate triangle has only edges.
    """
    a, b, c = corners.unbind(dim=1)
    ab, ac, ap = b - a, c - a, points - a
    bb, cc, bc = _dot(ab, ab), _dot(ac, ac), _dot(ab, ac)
    pb, pc = _dot(ap, ab), _dot(ap, ac)
    area = bb * cc - bc * bc
    safe = torch.where(area > 0, area, 1)
    beta, gamma = (cc * pb - bc * pc) / safe, (bb * pc - bc * pb) / safe
    inside = (area > 0) & (beta >= 0) & (gamma >= 0) & (beta + gamma <= 1)
    foot = a + beta[:, None] * ab + gamma[:, None] * ac
    best, least = foot, torch.where(inside, (foot - points).square().sum(dim=1), torch.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        edge = end - start
        length = _dot(edge, edge)
        along = _dot(points - start, edge) / torch.where(length > 0, length, 1)
        candidate = start + along.clamp(0, 1)[:, None] * edge
        square = (candidate - points).square().sum(dim=1)
        nearer = square < least
        best = torch.where(nearer[:, None], candidate, best)
        least = torch.where(nearer, square, least)
    return best


def _dot(a: Float[Tensor, "pair 3"], b: Float[Tensor, "pair 3"]) -> Float[Tensor, " pair"]:
    return (a * b).sum(dim=1)
