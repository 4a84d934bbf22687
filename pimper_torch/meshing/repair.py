"""Broken places of a surface, repaired: their vertices go where it bends least.

The faces stay as they are, so that what was closed stays closed.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.config import require
from pimper_torch.geometry.components import vertex_components
from pimper_torch.geometry.surfaces import boundary_vertices, corners_of, vertex_normals
from pimper_torch.meshing.faults import faults
from pimper_torch.meshing.groups import diagonal, small_groups
from pimper_torch.meshing.plates import least_bent
from pimper_torch.records import Surface
from pimper_torch.stage import Stage

# Rings of sound vertices that a place which stays broken may take in, one at a time.
_RINGS = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class RepairConfig:
    """What of a surface is broken, and how far a broken place may extend to be repaired.

    Attributes:
        max_extent: Diagonal of a repaired place's bounding box, as a fraction of the surface's; 0
            repairs nothing.
        max_stretch: Longest edge of a face, in multiples of the surface's median edge; longer
            ones are spikes.
    """

    max_extent: float = 0.1
    max_stretch: float = 10.0

    def __post_init__(self) -> None:
        require(self.max_extent >= 0, "repair.max_extent", self.max_extent, "0 or more")
        require(self.max_stretch > 1, "repair.max_stretch", self.max_stretch, "above 1")


class Repair(Stage):
    """Repair spikes and folds that other faces enclose, before a round or a mesh builds on them.

    A fold that is left would be carried by the next round's templates, and grow there. Mended
    vertices have no confidence, and the normals of where they are put.

    Differentiable in the vertices that stay; which these are is a constant.
    """

    def __init__(self, config: RepairConfig | None = None) -> None:
        super().__init__()
        self.config = config or RepairConfig()

    def forward(self, surface: Surface) -> Surface:
        """Repair what can be repaired."""
        if self.config.max_extent == 0:
            return surface
        vertices, faces = surface.vertices_world, surface.faces
        before = vertices.detach()
        found = faults(before, faces, surface.facet, self.config.max_stretch)
        part, used = found.part(surroundings(faces, found.broken(before), len(vertices)))
        farthest = self.config.max_extent * diagonal(before)
        placed, moving = repair(vertices[used], part.faces, part.broken, farthest)
        vertices = vertices.index_copy(0, used, placed)
        moved = torch.zeros_like(surface.facet, dtype=torch.bool).index_put((used,), moving)
        beside = corners_of(faces, moved[faces].any(dim=1), len(vertices))
        return surface.replace(
            vertices_world=vertices,
            normals_world=torch.where(
                beside[:, None], vertex_normals(vertices, faces), surface.normals_world
            ),
            confidence=torch.where(moved, 0, surface.confidence),
        )


def repair(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    broken: Callable[[Float[Tensor, "vertex 3"]], Bool[Tensor, " face"]],
    max_extent: Float[Tensor, ""],
) -> tuple[Float[Tensor, "vertex 3"], Bool[Tensor, " vertex"]]:
    """Move the vertices of broken faces that sound ones enclose, until none is broken.

    The vertices of a group of broken faces are placed where the surface bends least; while some
    face there is broken still, the group takes in the vertices round it. A group that touches
    the border, or extends too far, or stays broken, is left as it is.

    Args:
        vertices: World.
        faces: Of the surface. Edges without two of them are its border.
        broken: Marks faces, for vertices anywhere.
        max_extent: Diagonal of a group's bounding box, once it is placed.

    Returns:
        The vertices, and which of them were moved.

    Differentiable in the vertices that stay; which these are is a constant.
    """
    before, count = vertices.detach(), len(vertices)
    held = boundary_vertices(faces, count)
    free = corners_of(faces, broken(before), count)
    free = _anchored(faces, free & ~_together(faces, free, held))
    for ring in range(_RINGS + 1):
        places = least_bent(before, faces, free)
        held = held | (free & ~small_groups(places, faces, free, max_extent))
        free = free & ~held
        still = _together(faces, free, corners_of(faces, broken(places), count))
        if not bool(still.any()):
            break
        wider = corners_of(faces, still[faces].any(dim=1), count) & ~held
        free = free & ~still if ring == _RINGS else _anchored(faces, free | wider)
    return least_bent(vertices, faces, free), free


def surroundings(
    faces: Int[Tensor, "face 3"], broken: Bool[Tensor, " face"], num_vertices: int
) -> Bool[Tensor, " face"]:
    """Mark the faces round broken ones that :func:`repair` may look at: it needs no others."""
    near = broken
    for _ in range(_RINGS + 3):  # the plate is clamped by two rings, and one tells the border
        near = corners_of(faces, near, num_vertices)[faces].any(dim=1)
    return near


def _together(
    faces: Int[Tensor, "face 3"], among: Bool[Tensor, " vertex"], some: Bool[Tensor, " vertex"]
) -> Bool[Tensor, " vertex"]:
    """Mark all of every connected group that has some."""
    label = vertex_components(faces, among)
    named = torch.zeros_like(among)
    named[label[among & some]] = True
    return among & named[label]


def _anchored(
    faces: Int[Tensor, "face 3"], free: Bool[Tensor, " vertex"]
) -> Bool[Tensor, " vertex"]:
    """Leave out groups that make up all they hang together with."""
    of_face = free[faces]
    mixed = of_face.any(dim=1) & ~of_face.all(dim=1)
    return _together(faces, free, corners_of(faces, mixed, len(free)))
