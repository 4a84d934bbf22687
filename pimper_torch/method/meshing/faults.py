"""Defective faces: stretched, overturned, folded; and connected components of vertices."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.ground.geometry import topology
from pimper_torch.ground.geometry.surfaces import face_normals, side_lengths, unit_face_normals
from pimper_torch.ground.shapes import FaceMask, Faces, Scalar, VertexMask, Vertices

# Angle between the normals of neighbouring faces above which they lie on each other. A choice: at
# edges of a box or of thin bones it is a right angle, give or take the noise of small faces.
_FOLD = math.radians(110.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Faults:
    """Criteria for defective faces of a surface, for any position of its vertices.

    At a fold a surface turns back across one edge; where it bends, however far in all, it takes
    several. Overturned faces without a fold round their component are on a facet that bends far.

    Attributes:
        along: Mean normal of each face's facet, weighted by area, of any length.
        longest: Longest side of a sound face, scene units.
    """

    faces: Faces
    along: Float[Tensor, "face 3"]
    longest: Scalar

    def broken(self, vertices: Vertices) -> FaceMask:
        """Find faces stretched, on both sides of a fold, or overturned where a fold bounds them."""
        return self.stretched(vertices) | self._folded(vertices)

    def part(self, chosen: FaceMask) -> tuple["Faults", Int[Tensor, " used"]]:
        """Restrict to some of the faces; also list their vertices, which they index from 0."""
        used, corners = torch.unique(self.faces[chosen], return_inverse=True)
        return Faults(faces=corners, along=self.along[chosen], longest=self.longest), used

    def stretched(self, vertices: Vertices) -> FaceMask:
        """Find faces with a side that is too long."""
        return side_lengths(vertices[self.faces]).amax(dim=1) > self.longest

    def overturned(self, vertices: Vertices) -> FaceMask:
        """Find faces turned by more than 90 degrees from the mean normal of their facet."""
        return (face_normals(vertices, self.faces) * self.along).sum(dim=1) < 0

    def folded_over(self, vertices: Vertices, edges: topology.FaceEdges | None = None) -> FaceMask:
        """Find overturned faces where a fold bounds their component."""
        return self._folded(vertices, edges) & self.overturned(vertices)

    def _folded(self, vertices: Vertices, edges: topology.FaceEdges | None = None) -> FaceMask:
        normals, overturned = unit_face_normals(vertices, self.faces), self.overturned(vertices)
        pairs, _ = topology.face_pairs(self.faces, edges)
        one, other = pairs.unbind(dim=1)
        fold = (normals[one] * normals[other]).sum(dim=1) < math.cos(_FOLD)
        found = torch.zeros_like(overturned)
        found[pairs[fold].flatten()] = True
        label = topology.graph_components(pairs[overturned[one] & overturned[other]], len(found))
        bounded = torch.zeros_like(found)
        bounded[label[found & overturned]] = True
        return found | (overturned & bounded[label])


def faults(
    vertices: Vertices, faces: Faces, facet: Int[Tensor, " vertex"], max_stretch: float
) -> Faults:
    """Take the criteria for defective faces from a surface as it is.

    Args:
        facet: Of each vertex; a face belongs to the facet of most of its vertices.
        max_stretch: Longest side, in multiples of the median.
    """
    one, other, last = facet[faces].unbind(dim=1)
    owner = torch.where(other == last, other, one)
    normals = face_normals(vertices, faces)
    sums = normals.new_zeros(int(facet.max()) + 1, 3).index_add(0, owner, normals)
    longest = max_stretch * side_lengths(vertices[faces]).median()
    return Faults(faces=faces, along=sums[owner], longest=longest)


def small_groups(
    vertices: Vertices, faces: Faces, among: VertexMask, max_extent: Scalar
) -> VertexMask:
    """Find the vertices ``among`` whose connected component is small.

    Args:
        max_extent: Diagonal of a component's bounding box.
    """
    label = topology.vertex_components(faces, among)
    count = int(label.max()) + 1 if len(label) else 0
    index = label[:, None].expand_as(vertices)
    like = vertices.new_zeros(count, 3)
    high = like.scatter_reduce(0, index, vertices, "amax", include_self=False)
    low = like.scatter_reduce(0, index, vertices, "amin", include_self=False)
    small = (high - low).norm(dim=-1) <= max_extent
    return among & small[label]


def diagonal(vertices: Vertices) -> Scalar:
    """Return the diagonal of the points' bounding box."""
    return (vertices.amax(dim=0) - vertices.amin(dim=0)).norm()
