"""Faces that no surface has: drawn out, turned over, folded."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.components import graph_components
from pimper_torch.geometry.surfaces import face_normals, face_pairs, side_lengths

# Neighbouring faces turned further apart lie on each other. Edges of a box, and the rims of thin
# bones, turn by a right angle, give or take the noise of small faces.
_FOLD_DEG = 110.0


def stretched(
    vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"], most: float
) -> Bool[Tensor, " face"]:
    """Mark faces with a side longer than ``most`` times the median side of all."""
    sides = side_lengths(vertices[faces])
    return sides.amax(dim=1) > most * sides.median()


def overturned(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    facet: Int[Tensor, " vertex"],
) -> Bool[Tensor, " face"]:
    """Mark faces that look more than 90 degrees away from the mean of their facet.

    Args:
        vertices: World.
        faces: Of the surface.
        facet: Of each vertex; a face belongs to the facet that most of its vertices name.
    """
    means = facet_means(vertices, faces, facet)
    return (face_normals(vertices, faces) * means).sum(dim=-1) < 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Faults:
    """What is broken of a surface, wherever its vertices are moved.

    Beside a fold a surface turns round within one edge; where it bends, however far in all, it
    takes several. An overturned face without a fold round its like is on a facet that bends far.

    Attributes:
        faces: Of the surface.
        along: The way each was meant to look.
        longest: Side that a face may have, scene units.
        pairs: Faces that fraction an edge.
    """

    faces: Int[Tensor, "face 3"]
    along: Float[Tensor, "face 3"]
    longest: Float[Tensor, ""]
    pairs: Int[Tensor, "pair 2"]

    def broken(self, vertices: Float[Tensor, "vertex 3"]) -> Bool[Tensor, " face"]:
        """Mark faces drawn out, on both sides of a fold, or overturned where a fold bounds them."""
        return self._drawn(vertices) | self._folded(vertices)

    def worst(self, vertices: Float[Tensor, "vertex 3"]) -> Bool[Tensor, " face"]:
        """Mark faces drawn out, or overturned where a fold bounds them."""
        return self._drawn(vertices) | self._folded(vertices) & self._rotated(vertices)

    def part(self, chosen: Bool[Tensor, " face"]) -> tuple["Faults", Int[Tensor, " used"]]:
        """Look at some of the faces alone; their vertices, which have new numbers, come with it."""
        used, corners = torch.unique(self.faces[chosen], return_inverse=True)
        pairs, _ = face_pairs(corners)
        along, longest = self.along[chosen], self.longest
        part = Faults(faces=corners, along=along, longest=longest, pairs=pairs)
        return part, used

    def _drawn(self, vertices: Float[Tensor, "vertex 3"]) -> Bool[Tensor, " face"]:
        return side_lengths(vertices[self.faces]).amax(dim=1) > self.longest

    def _rotated(self, vertices: Float[Tensor, "vertex 3"]) -> Bool[Tensor, " face"]:
        return (face_normals(vertices, self.faces) * self.along).sum(dim=1) < 0

    def _folded(self, vertices: Float[Tensor, "vertex 3"]) -> Bool[Tensor, " face"]:
        normals = normalize(face_normals(vertices, self.faces), dim=1)
        one, other = self.pairs.unbind(dim=1)
        fold = (normals[one] * normals[other]).sum(dim=1) < math.cos(math.radians(_FOLD_DEG))
        found = torch.zeros_like(normals[:, 0], dtype=torch.bool)
        found[self.pairs[fold].flatten()] = True
        rotated = self._rotated(vertices)
        (places,) = torch.nonzero(rotated, as_tuple=True)
        rank = rotated.cumsum(dim=0) - 1
        group = graph_components(rank[self.pairs[rotated[self.pairs].all(dim=1)]], len(places))
        bounded = torch.zeros_like(places, dtype=torch.bool)
        bounded[group[found[places]]] = True
        found[places[bounded[group]]] = True
        return found


def faults(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    facet: Int[Tensor, " vertex"],
    max_stretch: float,
) -> Faults:
    """Learn from a surface as it is what to call broken.

    Args:
        vertices: World.
        faces: Of the surface.
        facet: Of each vertex. The mean of its faces says which way a face was meant to look.
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
    """Give each face the mean normal of its facet, by area, of any length."""
    owner = facet[faces].mode(dim=1).values
    normals = face_normals(vertices, faces)
    return normals.new_zeros(int(facet.max()) + 1, 3).index_add(0, owner, normals)[owner]
