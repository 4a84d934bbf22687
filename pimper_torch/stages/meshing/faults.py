"""Defective faces: stretched, overturned, folded; and connected components of vertices."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.geometry import topology
from pimper_torch.geometry.surfaces import face_normals, side_lengths, unit_face_normals
from pimper_torch.records.shapes import FaceMask, Faces, Scalar, VertexMask, Vertices

# Angle between the normals of neighbouring faces above which they overlap in a fold. A choice: at
# edges of a box or of thin bones it is a right angle, apart from the noise of small faces.
_FOLD = math.radians(110.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Faults:
    """Criteria for defective faces of a surface, for any position of its vertices.

    At a fold a surface turns back across a single edge; a bend, however large in total, takes
    several. Overturned faces without a fold around their component are on a facet that bends far.

    Attributes:
        along: Mean normal of each face's facet, weighted by area, not normalized.
        longest: Longest side of a sound face, scene units.
    """

    faces: Faces
    along: Float[Tensor, "face 3"]
    longest: Scalar

    def broken(self, vertices: Vertices) -> FaceMask:
        """Return faces stretched, at a fold, or overturned in a component that a fold bounds."""
        return self.stretched(vertices) | self._folded(vertices)

    def part(self, chosen: FaceMask) -> tuple["Faults", Int[Tensor, " used"]]:
        """Return the criteria for the chosen faces, renumbered, and the vertices that they use."""
        used, corners = torch.unique(self.faces[chosen], return_inverse=True)
        return Faults(faces=corners, along=self.along[chosen], longest=self.longest), used

    def stretched(self, vertices: Vertices) -> FaceMask:
        """Return faces with a side that is too long."""
        return side_lengths(vertices[self.faces]).amax(dim=1) > self.longest

    def overturned(self, vertices: Vertices) -> FaceMask:
        """Return faces turned by more than 90 degrees from the mean normal of their facet."""
        return (face_normals(vertices, self.faces) * self.along).sum(dim=1) < 0

    def folded_over(self, vertices: Vertices, edges: topology.FaceEdges | None = None) -> FaceMask:
        """Return overturned faces in components that a fold bounds."""
        return self._folded(vertices, edges) & self.overturned(vertices)

    def _folded(self, vertices: Vertices, edges: topology.FaceEdges | None = None) -> FaceMask:
        normals, overturned = unit_face_normals(vertices, self.faces), self.overturned(vertices)
        pairs, _ = topology.face_pairs(self.faces, edges)
        a, b = pairs.unbind(dim=1)
        fold = (normals[a] * normals[b]).sum(dim=1) < math.cos(_FOLD)
        folded = torch.zeros_like(overturned)
        folded[pairs[fold].flatten()] = True
        label = topology.graph_components(pairs[overturned[a] & overturned[b]], len(folded))
        bounded = torch.zeros_like(folded)
        bounded[label[folded & overturned]] = True
        return folded | (overturned & bounded[label])


def faults(
    vertices: Vertices, faces: Faces, facet: Int[Tensor, " vertex"], max_stretch: float
) -> Faults:
    """Return the criteria for defective faces, from the current shape of a surface.

    Args:
        facet: Facet of each vertex; a face belongs to the facet of most of its vertices.
        max_stretch: Longest side, in multiples of the median.
    """
    a, b, c = facet[faces].unbind(dim=1)
    owner = torch.where(b == c, b, a)
    normals = face_normals(vertices, faces)
    sums = normals.new_zeros(int(facet.max()) + 1, 3).index_add(0, owner, normals)
    longest = max_stretch * side_lengths(vertices[faces]).median()
    return Faults(faces=faces, along=sums[owner], longest=longest)


def small_groups(
    vertices: Vertices, faces: Faces, among: VertexMask, max_extent: Scalar
) -> VertexMask:
    """Return the vertices ``among`` in small connected components.

    Args:
        max_extent: Largest diagonal of a component's bounding box.
    """
    label = topology.vertex_components(faces, among)
    count = int(label.max()) + 1 if len(label) else 0
    index = label[:, None].expand_as(vertices)
    like = vertices.new_zeros(count, 3)
    high = like.scatter_reduce(0, index, vertices, "amax", include_self=False)
    low = like.scatter_reduce(0, index, vertices, "amin", include_self=False)
    small = (high - low).norm(dim=-1) <= max_extent
    return among & small[label]


def bounding_diagonal(vertices: Vertices) -> Scalar:
    """Return the diagonal of the points' bounding box."""
    return (vertices.amax(dim=0) - vertices.amin(dim=0)).norm()
