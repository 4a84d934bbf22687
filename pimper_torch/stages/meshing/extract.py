"""Extraction of the mesh from the joined surface."""

import torch
from torch.nn.functional import normalize

from pimper_torch.geometry import topology
from pimper_torch.geometry.surfaces import component_areas, face_normals
from pimper_torch.linalg.sums import total
from pimper_torch.records import Mesh, Surface
from pimper_torch.records.shapes import FaceMask, Faces, PerVertex, Scalar, Vertices
from pimper_torch.runtime.errors import ReconstructionError
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.reporting import add_counts
from pimper_torch.stages.meshing.borders import protruding
from pimper_torch.stages.meshing.faults import bounding_diagonal, faults, small_groups
from pimper_torch.stages.meshing.meshing_config import ExtractConfig
from pimper_torch.stages.stage import Stage

# Approximate width of protrusions that are cut off a border, over a facet's side. A choice: a skull
# keeps the edge of its teeth, which it lost with 1, and its base ends smoothly.
_TOOTH = 0.7
# Expected error, in multiples of the surface's median, above which surface is not determined. It is
# above 8 for three quarters of the faces of the skull's flaps, and 1 for the median of its other
# faces; with 5 the flaps are removed, and 8 % of the faces cut without this limit stay.
_UNSURE = 5.0


class Extract(Stage):
    """Extract the mesh that the photographs support, a manifold.

    Faces without support, spikes, overturned faces of folds, and undetermined protrusions of
    borders (:mod:`~pimper_torch.stages.meshing.borders`) are dropped. Large components of the rest
    are kept. If two fans of faces meet only at a vertex, each gets its own copy. Orientation is
    that of the coarse mesh: counter-clockwise from outside.

    Differentiable in vertices, normals, albedo and confidence; the selection of faces is constant.
    """

    kept_as = Mesh

    def __init__(self, config: ExtractConfig | None = None) -> None:
        super().__init__()
        self.config = config or ExtractConfig()

    def forward(self, surface: Surface) -> Mesh:
        """Return the extracted mesh.

        A surface without any support, as from photographs without texture under one light, is
        kept completely. Raises :class:`ReconstructionError` if no face is left.
        """
        vertices = surface.vertices_world.detach()
        supported = surface.supported
        if not bool(supported.any()):
            supported = ~supported
        max_hole = self.config.max_hole * bounding_diagonal(vertices)
        filled = small_groups(vertices, surface.faces, ~supported, max_hole)
        keep = (supported | filled)[surface.faces].all(dim=1)
        leave_out("extract.support", ~keep, at=(vertices, surface.faces))
        error, bound = surface.expected_error, self.config.max_expected_error
        if error is not None:
            near = (error <= bound * bounding_diagonal(vertices))[surface.faces].all(dim=1)
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
                f"extraction: {with_support} of {len(surface.faces)} faces have support, and "
                f"{len(faces)} of these are not spikes; at least one is needed. Raise "
                f"`extract.max_expected_error` (now {bound}) or `extract.max_stretch` (now "
                f"{self.config.max_stretch}), or check the fraction of missing data in the report."
            )
        unsure = ~surface.supported if error is None else error > _UNSURE * _typical(surface, error)
        length = _TOOTH * facet_side(surface)
        teeth = protruding(vertices, faces, length, unsure[faces].any(dim=1), (edges, index))
        leave_out("extract.borders", teeth & ~teeth.all(), at=(vertices, faces))
        if not bool(teeth.all()):  # a surface as narrow as a facet is all teeth, and stays
            faces, index = faces[~teeth], index[~teeth]
        large = large_components(vertices, faces, self.config.min_piece, (edges, index))
        leave_out("extract.pieces", ~large, at=(vertices, faces))
        source, faces = topology.vertex_fans(faces[large], (edges, index[large]))
        _, loop = topology.boundary_loops(faces)
        add_counts({"openings": int(loop.max()) + 1 if len(loop) else 0})
        return Mesh(
            vertices_world=surface.vertices_world[source],
            faces=faces,
            normals_world=normalize(surface.normals_world[source], dim=-1),
            albedo=surface.albedo[source],
            confidence=surface.confidence[source],
            expected_error=None if error is None else error[source],
        )


def _typical(surface: Surface, values: PerVertex) -> Scalar:
    """Return the median over facets of their mean, as vertices are denser on some facets."""
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
    """Return the components, connected by edges, with at least a fraction of the largest area.

    With a fraction of 1, only the first of the largest is returned.
    """
    label = topology.graph_components(topology.face_pairs(faces, edges)[0], len(faces))
    areas = component_areas(vertices, faces, label)
    if fraction == 1:
        return label == label[areas.argmax()]
    return areas >= fraction * areas.amax()
