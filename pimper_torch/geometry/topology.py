"""Edges, connected components, boundaries and vertex fans of triangle meshes.

Connected components are computed by scipy, on the CPU.
"""

import torch
from jaxtyping import Bool, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from pimper_torch.records.shapes import FaceMask, Faces, VertexMask

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
    """Return all edges once, lower vertex first, and the edge's index opposite to each corner."""
    if len(faces) == 0:
        return faces[:, :2], faces
    # One number per edge: comparing rows of two takes far longer.
    ahead, behind, size = faces.roll(-1, dims=1), faces.roll(1, dims=1), faces.max() + 1
    number = torch.minimum(ahead, behind) * size + torch.maximum(ahead, behind)
    key, index = torch.unique(number, return_inverse=True)
    return torch.stack([key // size, key % size], dim=1), index


def open_edges(faces: Faces) -> Ends:
    """Return the edges that do not have exactly two faces, once each, lower vertex first."""
    edges, index = face_edges(faces)
    return edges[face_counts(index) != 2]


def face_pairs(faces: Faces, edges: FaceEdges | None = None) -> tuple[Pairs, Pairs]:
    """Return the pairs of faces that share an edge.

    Args:
        edges: Result of :func:`face_edges` for these faces or more, with only the rows of these.

    Returns:
        For every edge with exactly two faces: the faces, and the edge's two vertices.
    """
    corners, ends = _paired(faces, edges)
    return corners // 3, ends


def _paired(faces: Faces, edges: FaceEdges | None) -> tuple[Pairs, Pairs]:
    """Return the corners opposite to every edge with exactly two faces, and its vertices."""
    ends, index = face_edges(faces) if edges is None else edges
    edge, zeros = index.flatten(), index.new_zeros(len(ends))
    corner = torch.arange(len(edge), device=edge.device)
    first = zeros.scatter_reduce(0, edge, corner, "amin", include_self=False)
    last = zeros.scatter_reduce(0, edge, corner, "amax", include_self=False)
    two = face_counts(index, len(ends)) == 2
    return torch.stack([first[two], last[two]], dim=1), ends[two]


def first_of_each(rows: Int[Tensor, "row column"]) -> Int[Tensor, " kept"]:
    """Return the index of the first of each group of equal rows, ascending.

    >>> first_of_each(torch.tensor([[3, 4], [1, 2], [3, 4]]))
    tensor([0, 1])
    """
    _, label = torch.unique(rows, dim=0, return_inverse=True)
    order = torch.arange(len(label), device=label.device)
    first = torch.full_like(label, len(label)).scatter_reduce(0, label, order, "amin")
    return first[: int(label.max()) + 1 if len(label) else 0].sort().values


def face_counts(face_edge: Faces, num_edges: int = 0) -> Int[Tensor, " edge"]:
    """Return the number of faces at every edge, from the indices of :func:`face_edges`."""
    return torch.bincount(face_edge.flatten(), minlength=num_edges)


def boundary_vertices(faces: Faces, num_vertices: int) -> Bool[Tensor, " {num_vertices}"]:
    """Return the mask of vertices on an edge with one face, or more than two."""
    return _marked(open_edges(faces), num_vertices)


def corners_of(
    faces: Faces, chosen: FaceMask | Int[Tensor, " chosen"], num_vertices: int
) -> Bool[Tensor, " {num_vertices}"]:
    """Return the mask of the vertices of chosen faces."""
    return _marked(faces[chosen], num_vertices)


def dilated(faces: Faces, mask: FaceMask, rings: int, num_vertices: int) -> FaceMask:
    """Return a mask of faces enlarged by a number of rings of faces."""
    for _ in range(rings):
        mask = corners_of(faces, mask, num_vertices)[faces].any(dim=1)
    return mask


def connected_to(faces: Faces, among: FaceMask, marked: FaceMask) -> FaceMask:
    """Return the connected components of the faces ``among`` that have a marked face."""
    label = face_components(faces, among)
    count = torch.zeros_like(label).index_add(0, label, (marked & among).long())
    return among & (count[label] > 0)


def _marked(vertices: Int[Tensor, "..."], num_vertices: int) -> Bool[Tensor, " {num_vertices}"]:
    marked = torch.zeros(num_vertices, dtype=torch.bool, device=vertices.device)
    marked[vertices.flatten()] = True
    return marked


def vertex_components(faces: Faces, among: VertexMask) -> Int[Tensor, " vertex"]:
    """Label connected components of the vertices ``among``; each other vertex is one of its own."""
    edges = half_edges(faces)
    return graph_components(edges[among[edges].all(dim=1)], len(among))


def face_components(faces: Faces, among: FaceMask | None = None) -> Int[Tensor, " face"]:
    """Label components of faces connected by edges with exactly two faces, not by vertices alone.

    Args:
        among: Faces that connect; each other face is a separate component. All by default.
    """
    pairs, _ = face_pairs(faces)
    if among is not None:
        pairs = pairs[among[pairs].all(dim=1)]
    return graph_components(pairs, len(faces))


def vertex_fans(faces: Faces, edges: FaceEdges | None = None) -> tuple[Int[Tensor, " fan"], Faces]:
    """Split non-manifold vertices: every fan of faces around a vertex gets its own copy.

    Args:
        edges: As for :func:`face_pairs`.

    Returns:
        The original of each new vertex, ascending, and the faces in new vertices. Vertices without
        faces are dropped; the centre of two fans, where the surface is not manifold, becomes two;
        faces at an edge of three or more are separated.

    >>> bow_tie = torch.tensor([[0, 1, 2], [2, 3, 4]])
    >>> vertex_fans(bow_tie)[0]
    tensor([0, 1, 2, 2, 3, 4])
    """
    # 32 bits save memory: a vertex has about six corners and six links.
    corners = _paired(faces, edges)[0].int()
    vertex, first = faces.flatten(), corners - corners % 3
    (a, b), (next_a, next_b) = ((first + (corners + by) % 3).unbind(dim=1) for by in (1, 2))
    flipped = vertex[a] == vertex[b]  # the faces are oriented differently
    links = a, torch.where(flipped, b, next_b), next_a, torch.where(flipped, next_b, b)
    label = graph_components(torch.stack(links, dim=1).reshape(-1, 2), 3 * len(faces)).long()
    old = torch.empty_like(label[: int(label.max()) + 1]).scatter(0, label, faces.flatten())
    order = old.argsort(stable=True)
    new = torch.empty_like(order).scatter(0, order, torch.arange(len(order)).to(order))
    return old[order], new[label].reshape(-1, 3)


def boundary_loops(faces: Faces, bare: Pairs | None = None) -> tuple[Ends, Int[Tensor, " edge"]]:
    """Group the boundary edges of a surface into loops: one for every hole and outer boundary.

    Holes that meet at a vertex are one loop, as the surface is not connected there. An edge of
    three or more faces is a boundary of all of them.

    Args:
        bare: Result of :func:`open_edges`, if available.

    Returns:
        The boundary edges, and the index of each one's loop.

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
    source, split = vertex_fans(faces[on_border[faces].any(dim=1)])
    edges, index = face_edges(split)
    single = face_counts(index) == 1
    border = edges[single & on_border[source[edges]].all(dim=1)]
    label = graph_components(border, len(source))[border[:, 0]]
    return source[border], torch.unique(label, return_inverse=True)[1]


def graph_components(links: Int[Tensor, "link 2"], count: int) -> Int[Tensor, " node"]:
    """Label the nodes of an undirected graph by connected component."""
    start, end = links.cpu().numpy().T
    graph = coo_array((start >= 0, (start, end)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    return torch.from_numpy(label).to(links)
