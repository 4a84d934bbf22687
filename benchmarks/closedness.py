"""Check whether a surface is closed: openings, non-manifold edges, folds."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.geometry.surfaces import unit_face_normals
from pimper_torch.geometry.topology import (
    boundary_loops,
    face_components,
    face_edges,
    face_pairs,
)
from pimper_torch.records import Mesh, Record
from pimper_torch.runtime.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Closedness(Record):
    """The defects that keep a mesh from bounding a solid.

    Attributes:
        loops: Length of every loop of the border, the longest first, scene units.
        edges: How many edges each has.
        crowded: Edges that three faces share, or more.
        twisted: Edges whose two faces disagree about which side is out.
        folds: Edges where the surface turns by more than the given angle.
        pieces: Components of faces connected by edges.
        euler: Vertices less edges plus faces; 2 for a sphere, 1 for a disc.
        diagonal: Of the bounding box, scene units.
    """

    loops: Float[Tensor, " loop"]
    edges: Int[Tensor, " loop"]
    crowded: int
    twisted: int
    folds: int
    pieces: int
    euler: int
    diagonal: float

    @property
    def closed(self) -> bool:
        """Whether it bounds a body: no border, and two faces, agreeing, at every edge."""
        return len(self.loops) == 0 and self.crowded == 0 and self.twisted == 0

    @property
    def border_percent(self) -> float:
        """Length of the whole border, in per cent of the diagonal."""
        return 100 * float(self.loops.sum()) / self.diagonal

    @property
    def handles(self) -> int:
        """Total number of handles of all pieces.

        Meaningless with crowded edges, or if pieces or openings meet in a vertex.
        """
        return (2 * self.pieces - self.euler - len(self.loops)) // 2


def closedness(mesh: Mesh, *, fold_deg: float = 90.0) -> Closedness:
    """Find the defects that keep a mesh from being closed.

    Args:
        mesh: Any; vertices without faces are ignored. Duplicate vertices at one position are
            a border.
        fold_deg: Angle between the normals of neighbouring faces, above which it is folded
            there. Faces without area have none.

    Raises:
        InputError: A mesh without faces.
    """
    vertices, faces = mesh.vertices_world.detach().double(), mesh.faces
    if len(faces) == 0:
        raise InputError(
            f"closedness: a mesh of {len(vertices)} vertices without faces; needed: a surface. "
            "Check the mesh file."
        )
    ends, index = face_edges(faces)
    sharing = torch.bincount(index.flatten(), minlength=len(ends))
    # A face runs along an edge upwards or downwards in number; its neighbour the other way.
    upwards = (faces.roll(-2, dims=1) > faces.roll(-1, dims=1)).long() * 2 - 1
    balance = torch.zeros_like(sharing).index_add(0, index.flatten(), upwards.flatten())
    pairs, _ = face_pairs(faces)
    normals = unit_face_normals(vertices, faces)
    rotation = (normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(dim=1)
    border, loop = boundary_loops(faces)
    steps = (vertices[border[:, 0]] - vertices[border[:, 1]]).norm(dim=1)
    lengths = steps.new_zeros(int(loop.max()) + 1 if len(loop) else 0).index_add(0, loop, steps)
    order = lengths.argsort(descending=True)
    used = torch.unique(faces)
    corners = vertices[used]
    return Closedness(
        loops=lengths[order],
        edges=torch.bincount(loop, minlength=len(lengths))[order],
        crowded=int((sharing > 2).sum()),
        twisted=int(((sharing == 2) & (balance != 0)).sum()),
        folds=int((rotation < math.cos(math.radians(fold_deg))).sum()),
        pieces=int(face_components(faces).max()) + 1,
        euler=len(used) - len(ends) + len(faces),
        diagonal=float((corners.amax(dim=0) - corners.amin(dim=0)).norm()),
    )
