"""Defective faces: stretched, overturned, folded."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.geometry.surfaces import face_normals, side_lengths, unit_face_normals
from pimper_torch.geometry.topology import face_pairs, graph_components

# Angle between the normals of neighbouring faces above which they lie on each other. A choice: at
# edges of a box or of thin bones it is a right angle, give or take the noise of small faces.
_FOLD_DEG = 110.0


def stretched(
    vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"], max_stretch: float
) -> Bool[Tensor, " face"]:
    """Mark faces with a side longer than ``max_stretch`` times the median side of all."""
    sides = side_lengths(vertices[faces])
    return sides.amax(dim=1) > max_stretch * sides.median()


def overturned(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    facet: Int[Tensor, " vertex"],
) -> Bool[Tensor, " face"]:
    """Mark faces turned by more than 90 degrees from the mean normal of their facet.

    Args:
        vertices: World.
        faces: Of the surface.
        facet: Of each vertex; a face belongs to the facet of most of its vertices.
    """
    means = facet_means(vertices, faces, facet)
    return (face_normals(vertices, faces) * means).sum(dim=-1) < 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Faults:
    """Criteria for defective faces of a surface, for any position of its vertices.

    At a fold a surface turns back across one edge; where it bends, however far in all, it takes
    several. Overturned faces without a fold round their component are on a facet that bends far.

    Attributes:
        faces: Of the surface.
        along: Mean normal of each face's facet, of any length.
        longest: Longest side of a sound face, scene units.
        pairs: Faces that share an edge.
    """

    faces: Int[Tensor, "face 3"]
    along: Float[Tensor, "face 3"]
    longest: Float[Tensor, ""]
    pairs: Int[Tensor, "pair 2"]

    def broken(self, vertices: Float[Tensor, "vertex 3"]) -> Bool[Tensor, " face"]:
        """Mark faces stretched, on both sides of a fold, or overturned where a fold bounds them."""
        return self._stretched(vertices) | self._folded(vertices)

    def worst(self, vertices: Float[Tensor, "vertex 3"]) -> Bool[Tensor, " face"]:
        """Mark faces stretched, or overturned where a fold bounds them."""
        return self._stretched(vertices) | self._folded(vertices) & self._overturned(vertices)

    def part(self, chosen: Bool[Tensor, " face"]) -> tuple["Faults", Int[Tensor, " used"]]:
        """Restrict to some of the faces; also list their vertices, which they index from 0."""
        used, corners = torch.unique(self.faces[chosen], return_inverse=True)
        pairs, _ = face_pairs(corners)
        along, longest = self.along[chosen], self.longest
        part = Faults(faces=corners, along=along, longest=longest, pairs=pairs)
        return part, used

    def _stretched(self, vertices: Float[Tensor, "vertex 3"]) -> Bool[Tensor, " face"]:
        return side_lengths(vertices[self.faces]).amax(dim=1) > self.longest

    def _overturned(self, vertices: Float[Tensor, "vertex 3"]) -> Bool[Tensor, " face"]:
        return (face_normals(vertices, self.faces) * self.along).sum(dim=1) < 0

    def _folded(self, vertices: Float[Tensor, "vertex 3"]) -> Bool[Tensor, " face"]:
        normals = unit_face_normals(vertices, self.faces)
        one, other = self.pairs.unbind(dim=1)
        fold = (normals[one] * normals[other]).sum(dim=1) < math.cos(math.radians(_FOLD_DEG))
        found = torch.zeros_like(normals[:, 0], dtype=torch.bool)
        found[self.pairs[fold].flatten()] = True
        overturned = self._overturned(vertices)
        (index,) = torch.nonzero(overturned, as_tuple=True)
        rank = overturned.cumsum(dim=0) - 1
        label = graph_components(rank[self.pairs[overturned[self.pairs].all(dim=1)]], len(index))
        bounded = torch.zeros_like(index, dtype=torch.bool)
        bounded[label[found[index]]] = True
        found[index[bounded[label]]] = True
        return found


def faults(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    facet: Int[Tensor, " vertex"],
    max_stretch: float,
) -> Faults:
    """Take the criteria for defective faces from a surface as it is.

    Args:
        vertices: World.
        faces: Of the surface.
        facet: Of each vertex; a face belongs to the facet of most of its vertices.
        max_stretch: Longest side, in multiples of the median.
    """
    pairs, _ = face_pairs(faces)
    return Faults(
        faces=faces,
        along=facet_means(vertices, faces, facet),
        longest=max_stretch * side_lengths(vertices[faces]).median(),
        pairs=pairs,
    )


def facet_means(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    facet: Int[Tensor, " vertex"],
) -> Float[Tensor, "face 3"]:
    """Give each face the mean normal of its facet, weighted by area, of any length."""
    owner = facet[faces].mode(dim=1).values
    normals = face_normals(vertices, faces)
    return normals.new_zeros(int(facet.max()) + 1, 3).index_add(0, owner, normals)[owner]
