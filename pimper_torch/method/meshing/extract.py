"""Extraction: the joined surface in, one connected mesh out."""

import torch
from torch.nn.functional import normalize

from pimper_torch.ground.geometry import topology
from pimper_torch.ground.geometry.surfaces import component_areas, face_normals
from pimper_torch.ground.linalg.sums import total
from pimper_torch.ground.shapes import FaceMask, Faces, PerVertex, Scalar, Vertices
from pimper_torch.method.meshing.borders import protruding
from pimper_torch.method.meshing.faults import diagonal, faults, small_groups
from pimper_torch.method.meshing.meshing_config import ExtractConfig
from pimper_torch.records import Mesh, Surface
from pimper_torch.runtime.errors import ReconstructionError
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.stage import Stage

# Of a facet's side: what sticks out of a border and is about so wide is cut off. A choice: with 1,
# a skull lost the edge of its teeth; so its base ends smoothly and they stay.
_TOOTH = 0.7
# Expected error, in multiples of the surface's median, from which surface is not determined. Of the
# skull's flaps 3 in 4 faces have more than 8, of its other faces the median has 1; with 5 the
# flaps go, and 8 % of what is cut without this limit stays.
_UNSURE = 5.0


class Extract(Stage):
    """Extract the mesh that the photographs support, a manifold.

    Faces without support are dropped, and so are spikes, faces that a fold turns over, and what
    sticks out of borders (:mod:`~pimper_torch.method.meshing.borders`) and is not determined. Of
    the remaining ones the large components stay, and where two fans of faces met in a vertex only,
    each gets its own copy. Orientation is the coarse mesh's: counter-clockwise from outside.

    Differentiable: faces are chosen without gradient, and vertices, normals, albedo and
    confidence of those keep theirs.
    """

    def __init__(self, config: ExtractConfig | None = None) -> None:
        super().__init__()
        self.config = config or ExtractConfig()

    def forward(self, surface: Surface) -> Mesh:
        """Extract the mesh.

        A surface without support anywhere, as of photographs without texture under one light, is
        kept whole.
        """
        vertices = surface.vertices_world.detach()
        supported = surface.supported
        if not bool(supported.any()):  # nowhere better than elsewhere
            supported = ~supported
        max_hole = self.config.max_hole * diagonal(vertices)
        filled = small_groups(vertices, surface.faces, ~supported, max_hole)
        keep = (supported | filled)[surface.faces].all(dim=1)
        leave_out("extract.support", ~keep, at=(vertices, surface.faces))
        error, bound = surface.expected_error, self.config.max_expected_error
        if error is not None:
            near = (error <= bound * diagonal(vertices))[surface.faces].all(dim=1)
            leave_out("extract.expected_error", keep & ~near, at=(vertices, surface.faces))
            keep &= near
        with_support = int(keep.sum())
        defects = faults(vertices, surface.faces, surface.facet, self.config.max_stretch)
        edges, index = topology.face_edges(surface.faces)
        spikes = defects.stretched(vertices) | defects.folded_over(vertices, (edges, index))
        leave_out("extract.spikes", keep & spikes, at=(vertices, surface.faces))
        faces, index = surface.faces[keep & ~spikes], index[keep & ~spikes]
        if len(faces) == 0:
            raise ReconstructionError(
                f"extraction: of {len(surface.faces)} faces {with_support} have support, and "
                f"{len(faces)} of those are no spikes; at least one is needed. Raise "
                f"`extract.max_expected_error` (now {bound}) or "
                f"`extract.max_stretch` (now {self.config.max_stretch}), or look at the fraction "
                "of missing data that the report gives."
            )
        unsure = ~surface.supported if error is None else error > _UNSURE * _typical(surface, error)
        length = _TOOTH * facet_side(surface)
        teeth = protruding(vertices, faces, length, unsure[faces].any(dim=1), (edges, index))
        leave_out("extract.borders", teeth & ~teeth.all(), at=(vertices, faces))
        if not bool(teeth.all()):  # where all is as narrow as a facet, it is the surface
            faces, index = faces[~teeth], index[~teeth]
        large = large_components(vertices, faces, self.config.min_piece, (edges, index))
        leave_out("extract.pieces", ~large, at=(vertices, faces))
        source, faces = topology.vertex_fans(faces[large], (edges, index[large]))
        return Mesh(
            vertices_world=surface.vertices_world[source],
            faces=faces,
            normals_world=normalize(surface.normals_world[source], dim=-1),
            albedo=surface.albedo[source],
            confidence=surface.confidence[source],
            expected_error=None if error is None else error[source],
        )


def _typical(surface: Surface, values: PerVertex) -> Scalar:
    """Return the median over facets of the mean on each: vertices lie closer on some."""
    count = torch.bincount(surface.facet)
    mean = torch.bincount(surface.facet, values.detach(), len(count)) / count
    return mean[count > 0].median()


def facet_side(surface: Surface) -> float:
    """Return the side of an equilateral facet of the mean area, scene units."""
    area = face_normals(surface.vertices_world.detach(), surface.faces).norm(dim=1) / 2
    count = max(len(torch.unique(surface.facet)), 1)
    return float((4 / 3**0.5 * total(area) / count).sqrt())


def large_components(
    vertices: Vertices, faces: Faces, fraction: float, edges: topology.FaceEdges
) -> FaceMask:
    """Find the components, connected by edges, with a fraction of the largest one's area.

    With a fraction of 1 only the first of the largest is marked.
    """
    label = topology.graph_components(topology.face_pairs(faces, edges)[0], len(faces))
    areas = component_areas(vertices, faces, label)
    if fraction == 1:
        return label == label[areas.argmax()]
    return areas >= fraction * areas.amax()
