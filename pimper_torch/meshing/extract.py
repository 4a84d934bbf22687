"""Extraction: the joined surface in, one connected mesh out."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import normalize

from pimper_torch.config import require
from pimper_torch.errors import ReconstructionError
from pimper_torch.geometry.components import face_components, vertex_fans
from pimper_torch.geometry.surfaces import face_normals, vertex_normals
from pimper_torch.meshing.faults import faults, overturned, stretched
from pimper_torch.meshing.groups import diagonal, small_groups
from pimper_torch.meshing.mend import mend, surroundings
from pimper_torch.records import Mesh, Surface


@dataclass(frozen=True, slots=True, kw_only=True)
class ExtractConfig:
    """What of the surface is worth keeping.

    Attributes:
        min_confidence: Vertices with no more than this have no support of their own.
        max_hole: Connected vertices without support stay, as a filled hole, when they
            extend over no more than this share of the surface's extent (both diagonals
            of bounding boxes).
        max_stretch: Longest edge of a face, in multiples of the surface's median edge;
            longer ones are spikes or cliffs. Infinite keeps all.
        drop_overturned: Leave out faces turned more than 90 degrees from the mean of
            their facet.
        max_mend: Spikes and folds that other faces enclose are mended in place of being left
            out, when they extend over no more than this share of the surface's extent: their
            vertices move to where the surface bends least, and lose their confidence. A face
            then counts as overturned only where a fold bounds it. 0 leaves all out.
        min_piece: Share of the largest connected piece's area that another one needs to be
            kept; 1 keeps the largest only.
    """

    min_confidence: float = 0.0
    max_hole: float = 1.0
    max_stretch: float = 10.0
    drop_overturned: bool = True
    max_mend: float = 0.1
    min_piece: float = 0.01

    def __post_init__(self) -> None:
        require(0 <= self.min_confidence < 1, "min_confidence", self.min_confidence, "in [0, 1)")
        require(self.max_hole >= 0, "max_hole", self.max_hole, "0 or more")
        require(self.max_stretch > 1, "max_stretch", self.max_stretch, "above 1")
        require(self.max_mend >= 0, "max_mend", self.max_mend, "0 or more")
        require(0 <= self.min_piece <= 1, "min_piece", self.min_piece, "in [0, 1]")


class Extract(nn.Module):
    """Keep what the photographs support, as one connected manifold mesh.

    Faces without support go. Spikes and folds inside of what remains are mended
    (:mod:`~pimper_torch.meshing.mend`), so that a closed surface stays closed; those at its
    border go. Of the rest the large pieces stay, and where two fans of faces touched in one
    vertex only, each gets its own copy. Orientation is the coarse mesh's: counter-clockwise
    from outside.

    Differentiable: what is kept is decided without gradient, and the kept vertices, normals,
    albedo and confidence carry theirs; mended vertices carry that of the vertices round them.
    """

    def __init__(self, config: ExtractConfig | None = None) -> None:
        super().__init__()
        self.config = config or ExtractConfig()

    def forward(self, surface: Surface) -> Mesh:
        """Extract the mesh.

        A surface without confidence anywhere, as under one light for all views, is kept
        whole.

        Raises:
            ReconstructionError: Nothing is left.
        """
        vertices = surface.vertices_world.detach()
        confidence = surface.confidence.detach()
        supported = confidence > self.config.min_confidence
        if not bool((confidence > 0).any()):  # nowhere better than elsewhere
            supported = supported.new_ones(supported.shape)
        max_hole = self.config.max_hole * diagonal(vertices)
        filled = small_groups(vertices, surface.faces, ~supported, max_hole)
        keep = (supported | filled)[surface.faces].all(dim=1)
        with_support = int(keep.sum())
        faces = surface.faces[keep]
        if self.config.max_mend > 0 and with_support:
            surface, spikes = self._mended(surface, faces)
        else:
            spikes = self._spikes(surface)[keep]
        faces = faces[~spikes]
        if len(faces) == 0:
            raise ReconstructionError(
                f"extraction: of {len(surface.faces)} faces {with_support} have support, and "
                f"{len(faces)} of those are no spikes; at least one is needed. Lower "
                f"`extract.min_confidence` (now {self.config.min_confidence}), raise "
                f"`extract.max_stretch` (now {self.config.max_stretch}), or look at the share "
                "of missing data that the report gives."
            )
        vertices = surface.vertices_world.detach()
        faces = faces[large_pieces(vertices, faces, self.config.min_piece)]
        source, faces = vertex_fans(faces)
        return Mesh(
            vertices_world=surface.vertices_world[source],
            faces=faces,
            normals_world=normalize(surface.normals_world[source], dim=-1),
            albedo=surface.albedo[source],
            confidence=surface.confidence[source],
        )

    def _spikes(self, surface: Surface) -> Bool[Tensor, " face"]:
        vertices = surface.vertices_world.detach()
        spikes = stretched(vertices, surface.faces, self.config.max_stretch)
        if self.config.drop_overturned:
            spikes = spikes | overturned(vertices, surface.faces, surface.facet)
        return spikes

    def _mended(
        self, surface: Surface, faces: Int[Tensor, "face 3"]
    ) -> tuple[Surface, Bool[Tensor, " face"]]:
        """Mend what can be mended of some faces, and mark those that cannot."""
        config, vertices = self.config, surface.vertices_world
        before = vertices.detach()
        found = faults(
            before, faces, surface.facet, config.max_stretch, folds=config.drop_overturned
        )
        near = surroundings(faces, found.broken(before), len(vertices))
        part, used = found.part(near)
        farthest = config.max_mend * diagonal(before)
        placed, moving = mend(vertices[used], part.faces, part.broken, farthest)
        spikes = near.index_put((near,), part.worst(placed.detach()))
        vertices = vertices.index_copy(0, used, placed)
        moved = torch.zeros_like(surface.facet, dtype=torch.bool).index_put((used,), moving)
        beside = torch.zeros_like(moved)
        beside[faces[moved[faces].any(dim=1)].flatten()] = True
        normals = torch.where(
            beside[:, None], vertex_normals(vertices, faces), surface.normals_world
        )
        mended = surface.replace(
            vertices_world=vertices,
            normals_world=normals,
            confidence=torch.where(moved, 0, surface.confidence),
        )
        return mended, spikes


def large_pieces(
    vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"], share: float
) -> Bool[Tensor, " face"]:
    """Mark the faces of pieces with at least a share of the largest one's area.

    Pieces hang together by edges. With share 1 one piece is marked, the first of the largest.
    """
    label = face_components(faces)
    area = face_normals(vertices, faces).norm(dim=-1).double()
    areas = area.new_zeros(int(label.max()) + 1).index_add(0, label, area)
    large = areas >= share * areas.amax()
    if share == 1:
        large = torch.arange(len(areas), device=areas.device) == areas.argmax()
    return large[label]
