"""Edges, connected components, borders and vertex fans of triangle meshes.

Graphs are searched by scipy, on the CPU.
"""

import torch
from jaxtyping import Bool, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from pimper_torch.ground.shapes import FaceMask, Faces, VertexMask


def half_edges(faces: Faces) -> Int[Tensor, "half_edge 2"]:
    """List the three edges of every face in its direction: opposite to corners 0, 1 and 2.

    >>> half_edges(torch.tensor([[4, 5, 6]]))
    tensor([[5, 6],
            [6, 4],
            [4, 5]])
    """
    return faces[:, [1, 2, 2, 0, 0, 1]].reshape(-1, 2)


def face_edges(faces: Faces) -> tuple[Int[Tensor, "edge 2"], Faces]:
    """List every edge once, its lower vertex first, and which one is opposite to each corner."""
    if len(faces) == 0:
        return faces[:, :2], faces
    key, index = torch.unique(_edge_keys(faces), return_inverse=True)
    return _ends(key, faces), index


def open_edges(faces: Faces) -> Int[Tensor, "edge 2"]:
    """List the edges that do not have exactly two faces, once each, their lower vertex first."""
    if len(faces) == 0:
        return faces[:, :2]
    keys = _edge_keys(faces).flatten().sort().values
    key, counts = torch.unique_consecutive(keys, return_counts=True)
    return _ends(key[counts != 2], faces)


def _edge_keys(faces: Faces) -> Faces:
    """Number the edge opposite to each corner: rows of two would take far longer to compare."""
    ahead, behind = faces.roll(-1, dims=1), faces.roll(1, dims=1)
    return torch.minimum(ahead, behind) * (faces.max() + 1) + torch.maximum(ahead, behind)


def _ends(key: Int[Tensor, " edge"], faces: Faces) -> Int[Tensor, "edge 2"]:
    size = faces.max() + 1
    return torch.stack([key // size, key % size], dim=1)


def face_pairs(faces: Faces) -> tuple[Int[Tensor, "pair 2"], Int[Tensor, "pair 2"]]:
    """Find which faces share an edge.

    Returns:
        For every edge with exactly two faces: the faces, and the edge's two vertices.
    """
    edges, index = face_edges(faces)
    counts = face_counts(index)
    order = index.flatten().argsort(stable=True)
    first = (counts.cumsum(dim=0) - counts)[counts == 2]
    return torch.stack([order[first], order[first + 1]], dim=1) // 3, edges[counts == 2]


def first_of_each(rows: Int[Tensor, "row column"]) -> Int[Tensor, " kept"]:
    """Index the first of equal rows, ascending.

    >>> first_of_each(torch.tensor([[3, 4], [1, 2], [3, 4]]))
    tensor([0, 1])
    """
    _, label = torch.unique(rows, dim=0, return_inverse=True)
    order = torch.arange(len(label), device=label.device)
    first = torch.full_like(label, len(label)).scatter_reduce(0, label, order, "amin")
    return first[: int(label.max()) + 1 if len(label) else 0].sort().values


def face_counts(face_edge: Faces) -> Int[Tensor, " edge"]:
    """Count the faces at every edge, from the edges of every face of :func:`face_edges`."""
    return torch.bincount(face_edge.flatten())


def boundary_vertices(faces: Faces, num_vertices: int) -> Bool[Tensor, " {num_vertices}"]:
    """Find vertices on an edge that has one face, or more than two."""
    return _marked(open_edges(faces), num_vertices)


def corners_of(
    faces: Faces, chosen: FaceMask, num_vertices: int
) -> Bool[Tensor, " {num_vertices}"]:
    """Find the vertices of some faces."""
    return _marked(faces[chosen], num_vertices)


def dilated(faces: Faces, some: FaceMask, rings: int, num_vertices: int) -> FaceMask:
    """Find some faces and a number of rings of faces round them."""
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


def vertex_fans(faces: Faces) -> tuple[Int[Tensor, " fan"], Faces]:
    """Split non-manifold vertices: every fan of faces round one gets a vertex of its own.

    Returns:
        The old vertex each new one is a copy of, ascending, and the faces in new vertices.
        Vertices without faces are gone; one in the centre of two fans, where the surface is not
        manifold, has become two; faces that met at an edge of three or more are separate.

    >>> bow_tie = torch.tensor([[0, 1, 2], [2, 3, 4]])
    >>> vertex_fans(bow_tie)[0]
    tensor([0, 1, 2, 2, 3, 4])
    """
    label = graph_components(_fan_links(faces), 3 * len(faces)).long()
    old = torch.empty_like(label[: int(label.max()) + 1]).scatter(0, label, faces.flatten())
    order = old.argsort(stable=True)
    rank = torch.empty_like(order).scatter(0, order, torch.arange(len(order)).to(order))
    return old[order], rank[label].reshape(-1, 3)


def _fan_links(faces: Faces) -> Int[Tensor, "link 2"]:
    """List the corners that two faces have in common, at both ends of every edge of theirs.

    Half as many bits as indices have elsewhere: there are six corners a vertex, and as many links.
    """
    pairs, ends = face_pairs(faces)
    links = torch.empty(2, *pairs.shape, dtype=torch.int32, device=faces.device)
    for end, at in zip(ends.unbind(dim=1), links, strict=True):
        for column, face in enumerate(pairs.unbind(dim=1)):
            second, third = (faces[face, corner] == end for corner in (1, 2))
            at[:, column] = 3 * face + second.int() + 2 * third.int()
    return links.flatten(0, 1)


def boundary_loops(faces: Faces) -> tuple[Int[Tensor, "edge 2"], Int[Tensor, " edge"]]:
    """Group the edges of a surface's border: every hole, and every outer border, is one loop.

    Holes that meet in a vertex are one, as the surface is not connected there. An edge of three
    faces or more is border of them all.

    Returns:
        The border's edges, and the index of the loop each is part of.

    >>> cone = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1]])
    >>> boundary_loops(cone)
    (tensor([[1, 2],
            [1, 3],
            [2, 3]]), tensor([0, 0, 0]))
    """
    border = open_edges(faces)
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
