"""Barycentric subdivision of a coarse triangle mesh into a dense, conforming one.

Every edge of the coarse mesh is cut into the number of pieces that the finer of its facets needs.
Every facet gets the triangular grid of its most finely cut edge. Where an edge has fewer pieces
than the grid, the grid's points on it slide to the nearest cut, and degenerate triangles are
removed. Where it has more, the triangles along it are cut into fans. So both facets of an edge use
the same cuts, whatever their sizes.

A long and narrow facet would be far too fine across its length. So its area limits the cuts of its
edges, which makes it slightly too coarse along its length.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.geometry.topology import face_edges
from pimper_torch.records import Record
from pimper_torch.records.shapes import Faces, Facets, PerFacet, PerVertex, Vertices

Corners = Float[Tensor, "corner 3"]  # vertices of the coarse mesh

# Number of vertices that a value is interpolated from, those of a face; and their minimum distance
# from its point in the weights, scene units.
_NUM_NEAREST, _MIN_DISTANCE = 3, 1e-12


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Subdivision(Record):
    """Subdivision of a coarse mesh.

    Attributes:
        points: Vertices, on the flat facets.
        facet: A facet that contains each vertex; a vertex on an edge or a corner of the coarse
            mesh exists once, with one of its facets.
        barycentric: Coordinates in that facet; exactly 0 on its edges.
        face_facet: Facet of each face.
        spacing: Target length of the faces' edges in each facet.
    """

    points: Vertices
    facet: Int[Tensor, " vertex"]
    barycentric: Vertices
    faces: Faces
    face_facet: Int[Tensor, " face"]
    spacing: PerFacet

    def interpolate(
        self, per_corner: Float[Tensor, "corner channel"], facets: Facets
    ) -> Float[Tensor, "vertex channel"]:
        """Interpolate values of the coarse mesh's vertices, one a row; continuous across edges."""
        corners = per_corner[facets[self.facet]]
        return (self.barycentric[..., None] * corners).sum(dim=1)


def subdivide(vertices: Corners, facets: Facets, spacing: PerFacet) -> Subdivision:
    """Subdivide a triangle mesh into faces with edges of about ``spacing``.

    Args:
        vertices: Of the coarse mesh. Unused ones are not in the result.
        facets: Faces of the coarse mesh; an edge may have any number of them.
        spacing: Target length of the faces' edges in each facet, scene units; an edge has that of
            its finer facet. Faces of a narrow facet are longer along it and shorter across.

    Returns:
        A mesh with the topology and the surface of the coarse mesh: parts of a coarse edge have as
        many faces as the edge, areas add up, and no face is flipped. Needles give needles.

    Differentiable in ``vertices`` through ``points``; the cuts are constants.

    >>> square = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    >>> faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    >>> subdivision = subdivide(square, faces, torch.full((2,), 0.5))
    >>> len(subdivision.points), len(subdivision.faces)
    (12, 14)
    """
    edges, facet_edges = face_edges(facets)
    ends = vertices.detach()[edges]
    length = (ends[:, 1] - ends[:, 0]).norm(dim=-1)
    area = face_normals(vertices.detach(), facets).norm(dim=-1) / 2
    equilateral = (4 / 3**0.5 * area).sqrt()  # side of an equilateral triangle of that area
    narrowest = torch.full_like(length, torch.inf).scatter_reduce(
        0, facet_edges.flatten(), equilateral.repeat_interleave(3), "amin"
    )
    # As for the diagonal of half a square: at most 2 vertices per squared spacing.
    length = torch.minimum(length, 1.32 * narrowest)
    counts = (length[facet_edges] / spacing.detach()[:, None]).round().long().clamp_min(1)
    pieces = counts.new_zeros(len(edges)).scatter_reduce(
        0, facet_edges.flatten(), counts.flatten(), "amax"
    )
    # Slot 0 is opposite to an edge with most pieces; the others are counted from it.
    first = counts.argmax(dim=1)
    slots = (first[:, None] + torch.arange(3, device=first.device)) % 3
    cuts = _Cuts(
        pieces=pieces,
        edges=edges,
        corner=facets.gather(1, slots),
        edge=facet_edges.gather(1, slots),
        slot=slots,
        size=counts.amax(dim=1),
        first_cut=len(vertices) + _starts(pieces - 1),
        first_inner=len(vertices) + int((pieces - 1).sum()),
    )
    return _assemble(vertices, facets, cuts, spacing.detach())


def transferred(
    values: PerVertex, source: Subdivision, points: Float[Tensor, "asked 3"]
) -> Float[Tensor, " asked"]:
    """Interpolate smooth vertex values of a subdivision at other points of the same facets.

    From the three nearest vertices, by inverse distance. Differentiable in ``values`` only.
    """
    tree = cKDTree(source.points.detach().cpu().double().numpy())
    queries = points.detach().cpu().double().numpy()
    count = min(_NUM_NEAREST, len(source.points))
    distance, nearest = tree.query(queries, k=list(range(1, count + 1)), workers=-1)
    inverse_distance = 1 / torch.from_numpy(distance).clamp_min(_MIN_DISTANCE)
    fraction = (inverse_distance / inverse_distance.sum(dim=1, keepdim=True)).to(values)
    return (fraction * values[torch.from_numpy(nearest).to(values.device)]).sum(dim=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Cuts:
    """Cuts of the edges, and each facet's corners and edges from slot 0."""

    pieces: Int[Tensor, " edge"]
    edges: Int[Tensor, "edge 2"]
    corner: Int[Tensor, "facet 3"]
    edge: Int[Tensor, "facet 3"]  # opposite to the corner of the same column
    slot: Int[Tensor, "facet 3"]  # index of that corner in the coarse facet
    size: Int[Tensor, " facet"]  # pieces of a side of its grid
    first_cut: Int[Tensor, " edge"]  # number of its first inner point
    first_inner: int  # number of the first point inside a facet

    def number(self, edge: Int[Tensor, "..."], cut: Int[Tensor, "..."]) -> Int[Tensor, "..."]:
        """Return the numbers of points on edges, given by their cuts counted from the lower end."""
        low, high = self.edges[edge].unbind(dim=-1)
        number = torch.where(cut == self.pieces[edge], high, self.first_cut[edge] + cut - 1)
        return torch.where(cut == 0, low, number)

    def cut(self, edge: Int[Tensor, "..."], number: Int[Tensor, "..."]) -> Int[Tensor, "..."]:
        """Return the cuts of points that are on the given edges; -1 for others."""
        low, high = self.edges[edge].unbind(dim=-1)
        cut, pieces = number - self.first_cut[edge] + 1, self.pieces[edge]
        cut = torch.where((cut > 0) & (cut < pieces), cut, -1)
        return torch.where(number == low, 0, torch.where(number == high, pieces, cut))


def _assemble(vertices: Corners, facets: Facets, cuts: _Cuts, spacing: PerFacet) -> Subdivision:
    """Subdivide all facets, those of one size at a time, and merge their points by number."""
    sizes = cuts.size
    inner_start = cuts.first_inner + _starts((sizes - 1) * (sizes - 2) // 2)
    numbers, coordinates, point_facets, faces, face_facets = [], [], [], [], []
    for size in torch.unique(sizes).tolist():
        members = (sizes == size).nonzero()[:, 0]
        steps, triangles = _grid(size, device=facets.device)
        slid = _slide(steps, cuts.pieces[cuts.edge[members]], size)
        # All facets share the numbers of corners, then of cuts of edges; inner points come last.
        start_slot, end_slot, cut, pieces = slid.unbind(dim=-1)
        start = cuts.corner[members].gather(1, start_slot)
        edge = cuts.edge[members].gather(1, 3 - start_slot - end_slot)
        from_lower = torch.where(start == cuts.edges[edge, 0], cut, pieces - cut)
        inner = (steps > 0).all(dim=1)
        inner_number = inner_start[members][:, None] + inner.cumsum(dim=0) - 1
        number = torch.where(inner, inner_number, cuts.number(edge, from_lower))
        # Barycentric coordinates in slots: of the grid for inner points, of the cut on an edge.
        fraction = (cut / pieces.clamp_min(1)).to(vertices)
        on_edge = vertices.new_zeros(*cut.shape, 3)
        on_edge = on_edge.scatter(2, slid[..., :2], torch.stack([1 - fraction, fraction], dim=-1))
        in_slots = torch.where(inner[:, None], steps.to(vertices) / size, on_edge)
        back = cuts.slot[members].argsort(dim=1)[:, None].expand_as(in_slots)
        numbers.append(number.flatten())
        coordinates.append(in_slots.gather(2, back).flatten(0, 1))
        point_facets.append(members[:, None].expand_as(number).flatten())
        faces.append(number[:, triangles].flatten(0, 1))
        face_facets.append(members[:, None].expand(-1, len(triangles)).flatten())
    face, face_facet = torch.cat(faces), torch.cat(face_facets)

    proper = (face != face.roll(1, dims=1)).all(dim=1)
    face, face_facet = _fanned(face[proper], face_facet[proper], cuts)

    used, index = torch.unique(torch.cat(numbers), return_inverse=True)
    row = torch.empty_like(used).scatter_reduce_(
        0, index, torch.arange(len(index), device=index.device), "amin", include_self=False
    )
    facet, barycentric = torch.cat(point_facets)[row], torch.cat(coordinates)[row]
    points = (barycentric[..., None] * vertices[facets[facet]]).sum(dim=1)
    return Subdivision(
        points=points,
        facet=facet,
        barycentric=barycentric,
        faces=torch.searchsorted(used, face),
        face_facet=face_facet,
        spacing=spacing,
    )


def _fanned(
    faces: Faces, facet: Int[Tensor, " face"], cuts: _Cuts
) -> tuple[Int[Tensor, "piece 3"], Int[Tensor, " piece"]]:
    """Cut faces along finely cut edges into fans, edge by edge of their facet."""
    for slot in range(3):
        edge = cuts.edge[facet, slot]
        cut = cuts.cut(edge[:, None].expand_as(faces), faces)
        on_edge = (cut >= 0) & (cut.roll(-1, dims=1) >= 0)
        # Corners in order, from the first one on the edge.
        order = (on_edge.long().argmax(dim=1)[:, None] + torch.arange(3, device=cut.device)) % 3
        start, end, _ = cut.gather(1, order).unbind(dim=1)
        step = torch.where(on_edge.any(dim=1), end - start, 0)
        count = step.abs().clamp_min(1)
        row = torch.arange(len(faces), device=faces.device).repeat_interleave(count)
        index = torch.arange(len(row), device=row.device) - _starts(count)[row]
        cut = start[row] + step.sign()[row] * index
        faces, facet, edge, step = faces.gather(1, order)[row], facet[row], edge[row], step[row]
        fan = [cuts.number(edge, cut), cuts.number(edge, cut + step.sign()), faces[:, 2]]
        faces = torch.where((step.abs() > 1)[:, None], torch.stack(fan, dim=1), faces)
    return faces, facet


def _starts(counts: Int[Tensor, " group"]) -> Int[Tensor, " group"]:
    """Return the start of each group when groups are concatenated."""
    return counts.cumsum(dim=0) - counts


def _grid(
    size: int, device: torch.device
) -> tuple[Int[Tensor, "point 3"], Int[Tensor, "triangle 3"]]:
    """Return the points of a triangular grid, as steps that add up to ``size``, and its faces."""
    rows, columns = torch.tril_indices(size + 1, size + 1, device=device)
    steps = torch.stack([size - rows, rows - columns, columns], dim=1)
    row, column = torch.tril_indices(size, size, device=device)
    top = row * (row + 1) // 2 + column
    below = (row + 1) * (row + 2) // 2 + column
    upright = torch.stack([top, below, below + 1], dim=1)
    rotated = torch.stack([top, below + 1, top + 1], dim=1)[column < row]
    return steps, torch.cat([upright, rotated])


def _slide(
    steps: Int[Tensor, "point 3"], pieces: Int[Tensor, "member 3"], size: int
) -> Int[Tensor, "member point 4"]:
    """Move points on edges to the nearest cut.

    Returns:
        The slots of the edge's two ends, the cut counted from the first one, and the number of
        pieces; 0 pieces for points inside the facet.
    """
    edge = torch.full_like(steps[:, 0], -1)
    for opposite in (0, 2, 1):  # corners are on two edges, either of which may be used
        edge = torch.where(steps[:, opposite] == 0, opposite, edge)
    start = torch.where(edge == 0, 1, 0)
    end = torch.where(edge == 2, 1, 2)
    passed = steps.gather(1, end[:, None])[:, 0]
    num_pieces = torch.where(edge >= 0, pieces[:, edge.clamp_min(0)], 0)
    # Halfway between two cuts, rounding towards slot 0: otherwise the centre triangle of a facet
    # with 1, 1 and 2 pieces would be degenerate.
    cut = (2 * passed * num_pieces + size - 1) // (2 * size)
    return torch.stack([start.expand_as(cut), end.expand_as(cut), cut, num_pieces], dim=-1)
