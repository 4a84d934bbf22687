"""The nearest point of a surface.

The one place that talks to fcpw. It searches on the CPU in float32 whatever the device of the
tensors; the distance to the face that it names is then computed in float64. Answers are
constants to autograd.
"""

from dataclasses import dataclass

import fcpw
import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from pimper_torch.ground.shapes import Points
from pimper_torch.records import Mesh, Record
from pimper_torch.runtime.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Nearest(Record):
    """Where surfaces are nearest to points.

    Attributes:
        face: Which contains them; of a point cloud, the index of the point.
    """

    distance: Float[Tensor, " point"]
    points: Points
    face: Int[Tensor, " point"]


class NearestSurface:
    """A mesh prepared for questions about its nearest point; a point cloud without faces.

    Degenerate faces count as the edges or points they have shrunk to. Vertices without a
    face are no part of a mesh that has faces. Of faces whose distances differ by less than a
    millionth of the extent of mesh and points, any may be taken for the nearest.

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

    def query(self, points: Points) -> Nearest:
        """Find the nearest place of the surface for every point."""
        asked = points.detach().cpu().double()
        if len(self._faces):
            found = fcpw.interaction_3D_list()
            anywhere = np.full(len(asked), np.inf, dtype=np.float32)
            self._scene.find_closest_points(self._columns(asked), anywhere, found)
            face = torch.tensor([one.primitive_index for one in found], dtype=torch.long)
            place = closest_on_triangles(asked, self._vertices[self._faces[face]])
        else:
            face = torch.from_numpy(np.asarray(self._tree.query(asked.numpy())[1])).long()
            place = self._vertices[face]
        return Nearest(
            distance=(asked - place).norm(dim=1).to(points),
            points=place.to(points),
            face=face.to(points.device),
        )

    def _columns(self, points: Points) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
        return np.asfortranarray((points - self._origin).float().numpy())


def closest_on_triangles(
    points: Float[Tensor, "pair 3"], corners: Float[Tensor, "pair 3 3"]
) -> Float[Tensor, "pair 3"]:
    """Return the point of each triangle that is nearest to its partner.

    It is the foot of the perpendicular where that is inside, else on the nearest edge. A
    degenerate triangle has edges only.
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
        place = start + along.clamp(0, 1)[:, None] * edge
        square = (place - points).square().sum(dim=1)
        nearer = square < least
        best = torch.where(nearer[:, None], place, best)
        least = torch.where(nearer, square, least)
    return best


def _dot(one: Float[Tensor, "pair 3"], other: Float[Tensor, "pair 3"]) -> Float[Tensor, " pair"]:
    return (one * other).sum(dim=1)
