"""Barycentric subdivided meshes: a coarse triangle mesh subdivided into a dense, conforming one.

Every edge of the coarse mesh is cut into as many pieces as the finer of its facets asks for, and
every facet carries the triangular grid of its own most finely cut edge. Where an edge has fewer
pieces, the grid's points on it slide to the nearest cut, and triangles that vanish thereby are left
out. Where it has more, the triangles along it are cut into fans. Both facets of an edge so use the
same cuts, whatever their sizes.

A long and narrow facet would be far too fine across its length, so the cuts of its edges are
limited by its area: it is then a little too coarse along its length.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from pimper_torch.ground.geometry.surfaces import face_normals
from pimper_torch.ground.geometry.topology import face_edges
from pimper_torch.ground.shapes import Faces, Facets, PerFacet, PerVertex, Vertices
from pimper_torch.records import Record

Corners = Float[Tensor, "corner 3"]  # vertices of the coarse mesh

# Vertices that a value is blended from, as many as a face has; and a distance, scene units, at
# which one counts alone.
_BLENDED, _TOGETHER = 3, 1e-12


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Subdivision(Record):
    """A coarse mesh, subdivided.

    Attributes:
        points: Where the vertices are on the flat facets.
        facet: A facet that contains each vertex; a vertex on an edge or a corner of the coarse
            mesh exists once and names one of its facets.
        barycentric: Where in that facet; exactly 0 on its edges.
        spacing: Wanted length of the pieces' edges in each facet.
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
        """Blend what is known at the coarse mesh's vertices; continuous across its edges.

        Args:
            per_corner: One row a vertex of the coarse mesh.
        """
        corners = per_corner[facets[self.facet]]
        return (self.barycentric[..., None] * corners).sum(dim=1)


def subdivide(vertices: Corners, facets: Facets, spacing: PerFacet) -> Subdivision:
    """Subdivide a triangle mesh into pieces of about ``spacing``.

    Args:
        vertices: Of the coarse mesh. Unused ones do not appear in the result.
        facets: Its faces, any number of them at an edge.
        spacing: Wanted length of the pieces' edges in each facet, scene units; an edge
            follows the finer of its facets. Pieces of a narrow facet are longer along it
            and shorter across.

    Returns:
        A mesh with the coarse mesh's topology and surface: an edge inside it has as many
        faces as the coarse edge it is part of, areas add up, and no face is flipped.
        Needle-shaped facets give needle-shaped faces.

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
    equilateral = (4 / 3**0.5 * area).sqrt()  # the side of one of that area
    narrowest = torch.full_like(length, torch.inf).scatter_reduce(
        0, facet_edges.flatten(), equilateral.repeat_interleave(3), "amin"
    )
    # The pieces of a half square's diagonal: at most 2 points a spacing squared.
    length = torch.minimum(length, 1.32 * narrowest)
    own = (length[facet_edges] / spacing.detach()[:, None]).round().long().clamp_min(1)
    pieces = own.new_zeros(len(edges)).scatter_reduce(
        0, facet_edges.flatten(), own.flatten(), "amax"
    )
    # Slot 0 opposite to a longest edge: the others are counted from slot 0.
    first = own.argmax(dim=1)
    slots = (first[:, None] + torch.arange(3, device=first.device)) % 3
    cuts = _Cuts(
        pieces=pieces,
        edges=edges,
        corner=facets.gather(1, slots),
        edge=facet_edges.gather(1, slots),
        slot=slots,
        size=own.amax(dim=1),
        first_cut=len(vertices) + _starts(pieces - 1),
        first_inner=len(vertices) + int((pieces - 1).sum()),
    )
    return _assemble(vertices, facets, cuts, spacing.detach())


def transferred(
    values: PerVertex, source: Subdivision, points: Float[Tensor, "asked 3"]
) -> Float[Tensor, " asked"]:
    """Return values known on a subdivided mesh at other points of the same facets.

    They are blended from the three nearest vertices, by the inverse of the distance. For what is
    smooth. A constant to autograd but in ``values``.
    """
    tree = cKDTree(source.points.detach().cpu().double().numpy())
    asked = points.detach().cpu().double().numpy()
    count = min(_BLENDED, len(source.points))
    apart, near = tree.query(asked, k=list(range(1, count + 1)), workers=-1)
    inverse_distance = 1 / torch.from_numpy(apart).clamp_min(_TOGETHER)
    fraction = (inverse_distance / inverse_distance.sum(dim=1, keepdim=True)).to(values)
    return (fraction * values[torch.from_numpy(near).to(values.device)]).sum(dim=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Cuts:
    """Subdivision of edges, and each facet's corners and edges from slot 0."""

    pieces: Int[Tensor, " edge"]
    edges: Int[Tensor, "edge 2"]
    corner: Int[Tensor, "facet 3"]
    edge: Int[Tensor, "facet 3"]  # opposite to the corner in the same place
    slot: Int[Tensor, "facet 3"]  # which corner of the coarse facet that is
    size: Int[Tensor, " facet"]  # pieces of a side of its grid
    first_cut: Int[Tensor, " edge"]
    first_inner: int

    def named(self, edge: Int[Tensor, "..."], cut: Int[Tensor, "..."]) -> Int[Tensor, "..."]:
        """Number the points of edges, by their cuts from the lower end on."""
        low, high = self.edges[edge].unbind(dim=-1)
        name = torch.where(cut == self.pieces[edge], high, self.first_cut[edge] + cut - 1)
        return torch.where(cut == 0, low, name)

    def cut(self, edge: Int[Tensor, "..."], name: Int[Tensor, "..."]) -> Int[Tensor, "..."]:
        """Return the cuts of points on edges; -1 of others."""
        low, high = self.edges[edge].unbind(dim=-1)
        cut, pieces = name - self.first_cut[edge] + 1, self.pieces[edge]
        cut = torch.where((cut > 0) & (cut < pieces), cut, -1)
        return torch.where(name == low, 0, torch.where(name == high, pieces, cut))


def _assemble(vertices: Corners, facets: Facets, cuts: _Cuts, spacing: PerFacet) -> Subdivision:
    """Lay the subdivided meshes of all facets, like sizes together, and number their points."""
    sizes = cuts.size
    inner_start = cuts.first_inner + _starts((sizes - 1) * (sizes - 2) // 2)
    names, places, owners, faces, owned = [], [], [], [], []
    for size in torch.unique(sizes).tolist():
        members = (sizes == size).nonzero()[:, 0]
        steps, triangles = _subdivision_of(size, device=facets.device)
        slid = _slide(steps, cuts.pieces[cuts.edge[members]], size)
        # Points are numbered so that facets agree: corners, then cuts of edges, then insides.
        start_slot, end_slot, cut, pieces = slid.unbind(dim=-1)
        start = cuts.corner[members].gather(1, start_slot)
        edge = cuts.edge[members].gather(1, 3 - start_slot - end_slot)
        from_lower = torch.where(start == cuts.edges[edge, 0], cut, pieces - cut)
        inner = (steps > 0).all(dim=1)
        number = inner_start[members][:, None] + inner.cumsum(dim=0) - 1
        named = torch.where(inner, number, cuts.named(edge, from_lower))
        # Barycentric coordinates in slots: the grid's inside, those of the cut on an edge.
        fraction = (cut / pieces.clamp_min(1)).to(vertices)
        on_edge = vertices.new_zeros(*cut.shape, 3)
        on_edge = on_edge.scatter(2, slid[..., :2], torch.stack([1 - fraction, fraction], dim=-1))
        place = torch.where(inner[:, None], steps.to(vertices) / size, on_edge)
        back = cuts.slot[members].argsort(dim=1)[:, None].expand_as(place)
        names.append(named.flatten())
        places.append(place.gather(2, back).flatten(0, 1))
        owners.append(members[:, None].expand_as(named).flatten())
        faces.append(named[:, triangles].flatten(0, 1))
        owned.append(members[:, None].expand(-1, len(triangles)).flatten())
    name, owner, place = torch.cat(names), torch.cat(owners), torch.cat(places)
    face, face_facet = torch.cat(faces), torch.cat(owned)

    whole = (face != face.roll(1, dims=1)).all(dim=1)
    face, face_facet = _fanned(face[whole], face_facet[whole], cuts)

    used, index = torch.unique(name, return_inverse=True)
    row = torch.empty_like(used).scatter_reduce_(
        0, index, torch.arange(len(name), device=name.device), "amin", include_self=False
    )
    facet, barycentric = owner[row], place[row]
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
    faces: Faces, owner: Int[Tensor, " face"], cuts: _Cuts
) -> tuple[Int[Tensor, "piece 3"], Int[Tensor, " piece"]]:
    """Cut faces along finely cut edges into fans; edge by edge at a corner of their facet."""
    for slot in range(3):
        edge = cuts.edge[owner, slot]
        cut = cuts.cut(edge[:, None].expand_as(faces), faces)
        both = (cut >= 0) & (cut.roll(-1, dims=1) >= 0)
        # On from the corner that the edge's part begins at.
        order = (both.long().argmax(dim=1)[:, None] + torch.arange(3, device=cut.device)) % 3
        start, end, _ = cut.gather(1, order).unbind(dim=1)
        step = torch.where(both.any(dim=1), end - start, 0)
        count = step.abs().clamp_min(1)
        row = torch.arange(len(faces), device=faces.device).repeat_interleave(count)
        at = torch.arange(len(row), device=row.device) - _starts(count)[row]
        at = start[row] + step.sign()[row] * at
        faces, owner, edge, step = faces.gather(1, order)[row], owner[row], edge[row], step[row]
        fan = [cuts.named(edge, at), cuts.named(edge, at + step.sign()), faces[:, 2]]
        faces = torch.where((step.abs() > 1)[:, None], torch.stack(fan, dim=1), faces)
    return faces, owner


def _starts(counts: Int[Tensor, " group"]) -> Int[Tensor, " group"]:
    """Return where each group begins when they are put in a row."""
    return counts.cumsum(dim=0) - counts


def _subdivision_of(
    size: int, device: torch.device
) -> tuple[Int[Tensor, "point 3"], Int[Tensor, "triangle 3"]]:
    """Return the vertices of one subdivided facet, as steps that add up to ``size``, and faces."""
    rows, columns = torch.tril_indices(size + 1, size + 1, device=device)
    steps = torch.stack([size - rows, rows - columns, columns], dim=1)
    row, column = torch.tril_indices(size, size, device=device)
    here = row * (row + 1) // 2 + column
    below = (row + 1) * (row + 2) // 2 + column
    upright = torch.stack([here, below, below + 1], dim=1)
    rotated = torch.stack([here, below + 1, here + 1], dim=1)[column < row]
    return steps, torch.cat([upright, rotated])


def _slide(
    steps: Int[Tensor, "point 3"], pieces: Int[Tensor, "member 3"], size: int
) -> Int[Tensor, "member point 4"]:
    """Move points on edges to the nearest cut.

    Returns:
        The slots of the edge's two ends, the cut counted from the first of them, and the
        number of pieces; 0 pieces for points inside the facet.
    """
    edge = torch.full_like(steps[:, 0], -1)
    for opposite in (0, 2, 1):  # corners are on two edges; either names them
        edge = torch.where(steps[:, opposite] == 0, opposite, edge)
    start = torch.where(edge == 0, 1, 0)
    end = torch.where(edge == 2, 1, 2)
    gone = steps.gather(1, end[:, None])[:, 0]
    cut_into = torch.where(edge >= 0, pieces[:, edge.clamp_min(0)], 0)
    # Half-way between two cuts, towards slot 0: at the far end, the centre triangle of a facet with
    # 1, 1 and 2 pieces would be flat.
    cut = (2 * gone * cut_into + size - 1) // (2 * size)
    return torch.stack([start.expand_as(cut), end.expand_as(cut), cut, cut_into], dim=-1)
