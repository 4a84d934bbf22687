"""Faces that no surface has: drawn out, turned over, folded."""

import math

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
    normals = face_normals(vertices, faces)
    owner = facet[faces].mode(dim=1).values
    total = normals.new_zeros(int(facet.max()) + 1, 3).index_add(0, owner, normals)
    return (normals * total[owner]).sum(dim=-1) < 0


class Folds:
    """Where a surface lies on itself, however its vertices are moved.

    Beside a fold a surface turns round within one edge; where it bends, however far in all, it
    takes several. An overturned face without a fold round its like is on a facet that bends far.

    Args:
        faces: Of the surface.
        facet: Of each vertex.
    """

    def __init__(self, faces: Int[Tensor, "face 3"], facet: Int[Tensor, " vertex"]) -> None:
        self.faces, self.facet = faces, facet
        self._pairs, _ = face_pairs(faces)

    def at(self, vertices: Float[Tensor, "vertex 3"]) -> Bool[Tensor, " face"]:
        """Mark the faces on both sides of a fold, and those overturned that it bounds."""
        normals = normalize(face_normals(vertices, self.faces), dim=1)
        one, other = self._pairs.unbind(dim=1)
        folded = (normals[one] * normals[other]).sum(dim=1) < math.cos(math.radians(_FOLD_DEG))
        beside = torch.zeros_like(normals[:, 0], dtype=torch.bool)
        beside[self._pairs[folded].flatten()] = True
        turned = self.overturned(vertices)
        (places,) = torch.nonzero(turned, as_tuple=True)
        rank = turned.cumsum(dim=0) - 1
        group = graph_components(rank[self._pairs[turned[self._pairs].all(dim=1)]], len(places))
        bounded = torch.zeros_like(places, dtype=torch.bool)
        bounded[group[beside[places]]] = True
        beside[places[bounded[group]]] = True
        return beside

    def overturned(self, vertices: Float[Tensor, "vertex 3"]) -> Bool[Tensor, " face"]:
        """Mark faces that look more than 90 degrees away from the mean of their facet."""
        return overturned(vertices, self.faces, self.facet)
