"""Edges, connected components, borders and vertex fans of triangle meshes.

Graphs are searched by scipy, on the CPU.
"""

import torch
from jaxtyping import Bool, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from pimper_torch.ground.shapes import FaceMask, Faces, VertexMask

Pairs = Int[Tensor, "pair 2"]
Ends = Int[Tensor, "edge 2"]
FaceEdges = tuple[Ends, Faces]


def half_edges(faces: Faces) -> Int[Tensor, "half_edge 2"]:
    """List the three edges of every face in its direction: opposite to corners 0, 1 and 2.

    >>> half_edges(torch.tensor([[4, 5, 6]]))
    tensor([[5, 6],
            [6, 4],
            [4, 5]])
    """
    return faces[:, [1, 2, 2, 0, 0, 1]].reshape(-1, 2)


def face_edges(faces: Faces) -> FaceEdges:
    """List every edge once, its lower vertex first, and which one is opposite to each corner."""
    if len(faces) == 0:
        return faces[:, :2], faces
    # A number for each: rows of two would take far longer to compare.
    ahead, behind, size = faces.roll(-1, dims=1), faces.roll(1, dims=1), faces.max() + 1
    number = torch.minimum(ahead, behind) * size + torch.maximum(ahead, behind)
    key, index = torch.unique(number, return_inverse=True)
    return torch.stack([key // size, key % size], dim=1), index


def open_edges(faces: Faces) -> Ends:
    """List the edges that do not have exactly two faces, once each, their lower vertex first."""
    edges, index = face_edges(faces)
    return edges[face_counts(index) != 2]


def face_pairs(faces: Faces, edges: FaceEdges | None = None) -> tuple[Pairs, Pairs]:
    """Find which faces share an edge.

    Args:
        edges: The result of :func:`face_edges`; if of more faces, with the rows of these.

    Returns:
        For every edge with exactly two faces: the faces, and the edge's two vertices.
    """
    corners, ends = _paired(faces, edges)
    return corners // 3, ends


def _paired(faces: Faces, edges: FaceEdges | None) -> tuple[Pairs, Pairs]:
    """List the corners opposite to every edge with exactly two faces, and the edge's vertices."""
    ends, index = face_edges(faces) if edges is None else edges
    edge, none = index.flatten(), index.new_zeros(len(ends))
    corner = torch.arange(len(edge), device=edge.device)
    first = none.scatter_reduce(0, edge, corner, "amin", include_self=False)
    last = none.scatter_reduce(0, edge, corner, "amax", include_self=False)
    two = face_counts(index, len(ends)) == 2
    return torch.stack([first[two], last[two]], dim=1), ends[two]


def first_of_each(rows: Int[Tensor, "row column"]) -> Int[Tensor, " kept"]:
    """Index the first of equal rows, ascending.

    >>> first_of_each(torch.tensor([[3, 4], [1, 2], [3, 4]]))
    tensor([0, 1])
    """
    _, label = torch.unique(rows, dim=0, return_inverse=True)
    order = torch.arange(len(label), device=label.device)
    first = torch.full_like(label, len(label)).scatter_reduce(0, label, order, "amin")
    return first[: int(label.max()) + 1 if len(label) else 0].sort().values


def face_counts(face_edge: Faces, num_edges: int = 0) -> Int[Tensor, " edge"]:
    """Count the faces at every edge, from the edges of every face of :func:`face_edges`."""
    return torch.bincount(face_edge.flatten(), minlength=num_edges)


def boundary_vertices(faces: Faces, num_vertices: int) -> Bool[Tensor, " {num_vertices}"]:
    """Find vertices on an edge that has one face, or more than two."""
    return _marked(open_edges(faces), num_vertices)


def corners_of(
    faces: Faces, chosen: FaceMask | Int[Tensor, " chosen"], num_vertices: int
) -> Bool[Tensor, " {num_vertices}"]:
    """Find the vertices of some faces."""
    return _marked(faces[chosen], num_vertices)


def dilated(faces: Faces, some: FaceMask, rings: int, num_vertices: int) -> FaceMask:
    """Find some faces and a number of rings of faces around them."""
    for _ in range(rings):
        some = corners_of(faces, some, num_vertices)[faces].any(dim=1)
    return some


def connected_to(faces: Faces, among: FaceMask, marked: FaceMask) -> FaceMask:
    """Find the connected components of the faces ``among`` that have a marked face."""
    label = face_components(faces, among)
    count = torch.zeros_like(label).index_add(0, label, (marked & among).long())
    return among & (count[label] > 0)


def _marked(vertices: Int[Tensor, "..."], num_vertices: int) -> Bool[Tensor, " {num_vertices}"]:
    marked = torch.zeros(num_vertices, dtype=torch.bool, device=vertices.device)
    marked[vertices.flatten()] = True
    return marked


def vertex_components(faces: Faces, among: VertexMask) -> Int[Tensor, " vertex"]:
    """Label vertices that edges connect through vertices ``among`` only.

    Every other vertex is a component alone.
    """
    edges = half_edges(faces)
    return graph_components(edges[among[edges].all(dim=1)], len(among))


def face_components(faces: Faces, among: FaceMask | None = None) -> Int[Tensor, " face"]:
    """Label faces connected by edges with exactly two faces; a common vertex is not enough.

    Args:
        among: Faces that connect; every other one is a component alone. All by default.
    """
    pairs, _ = face_pairs(faces)
    if among is not None:
        pairs = pairs[among[pairs].all(dim=1)]
    return graph_components(pairs, len(faces))


def vertex_fans(faces: Faces, edges: FaceEdges | None = None) -> tuple[Int[Tensor, " fan"], Faces]:
    """Split non-manifold vertices: every fan of faces around one gets a vertex of its own.

    Args:
        edges: As for :func:`face_pairs`.

    Returns:
        The old vertex each new one is a copy of, ascending, and the faces in new vertices.
        Vertices without faces are gone; one in the centre of two fans, where the surface is not
        manifold, has become two; faces that met at an edge of three or more are separate.

    >>> bow_tie = torch.tensor([[0, 1, 2], [2, 3, 4]])
    >>> vertex_fans(bow_tie)[0]
    tensor([0, 1, 2, 2, 3, 4])
    """
    # Half as many bits as indices have elsewhere: each vertex has six corners, and as many links.
    corners = _paired(faces, edges)[0].int()
    vertex, first = faces.flatten(), corners - corners % 3
    (one, other), (two, another) = ((first + (corners + by) % 3).unbind(dim=1) for by in (1, 2))
    along = vertex[one] == vertex[other]  # where the faces are oriented differently
    links = one, torch.where(along, other, another), two, torch.where(along, another, other)
    links_of_corners = torch.stack(links, dim=1).reshape(-1, 2)
    label = graph_components(links_of_corners, 3 * len(faces)).long()
    old = torch.empty_like(label[: int(label.max()) + 1]).scatter(0, label, faces.flatten())
    order = old.argsort(stable=True)
    rank = torch.empty_like(order).scatter(0, order, torch.arange(len(order)).to(order))
    return old[order], rank[label].reshape(-1, 3)


def boundary_loops(faces: Faces, bare: Pairs | None = None) -> tuple[Ends, Int[Tensor, " edge"]]:
    """Group the edges of a surface's border: every hole, and every outer border, is one loop.

    Holes that meet in a vertex are one, as the surface is not connected there. An edge of three
    faces or more is border of them all. The result of :func:`open_edges` is ``bare``, if known.

    Returns:
        The border's edges, and the index of the loop each is part of.

    >>> cone = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1]])
    >>> boundary_loops(cone)
    (tensor([[1, 2],
            [1, 3],
            [2, 3]]), tensor([0, 0, 0]))
    """
    border = open_edges(faces) if bare is None else bare
    if len(border) == 0:
        return border, border[:, 0]
    on_border = _marked(border, int(faces.max()) + 1)
    source, separate = vertex_fans(faces[on_border[faces].any(dim=1)])
    edges, index = face_edges(separate)
    alone = face_counts(index) == 1
    border = edges[alone & on_border[source[edges]].all(dim=1)]
    label = graph_components(border, len(source))[border[:, 0]]
    return source[border], torch.unique(label, return_inverse=True)[1]


def graph_components(links: Int[Tensor, "link 2"], count: int) -> Int[Tensor, " node"]:
    """Label the nodes of an undirected graph by connected component."""
    one, other = links.cpu().numpy().T
    graph = coo_array((one >= 0, (one, other)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    return torch.from_numpy(label).to(links)
