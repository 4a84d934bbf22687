"""What hangs together in a triangle mesh. Graphs are searched by scipy, on the CPU."""

import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from pimper_torch.geometry.surfaces import face_edges, face_normals, face_pairs


def vertex_components(
    faces: Int[Tensor, "face 3"], among: Bool[Tensor, " vertex"]
) -> Int[Tensor, " vertex"]:
    """Label vertices that edges connect through vertices ``among`` only.

    Every other vertex is a component alone.
    """
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    return graph_components(edges[among[edges].all(dim=1)], len(among))


def face_components(faces: Int[Tensor, "face 3"]) -> Int[Tensor, " face"]:
    """Label faces that hang together by edges with exactly two faces; a vertex is not enough."""
    pairs, _ = face_pairs(faces)
    return graph_components(pairs, len(faces))


def component_areas(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    label: Int[Tensor, " face"],
    counted: Bool[Tensor, " face"] | None = None,
) -> Float[Tensor, " face"]:
    """Give each face the area of all faces with its label, or of those that count; float64."""
    area = face_normals(vertices, faces).norm(dim=-1).double() / 2
    if counted is not None:
        area = area * counted
    return torch.zeros_like(area).index_add(0, label, area)[label]


def vertex_fans(
    faces: Int[Tensor, "face 3"],
) -> tuple[Int[Tensor, " fan"], Int[Tensor, "face 3"]]:
    """Give every fan of faces round a vertex a vertex of its own.

    Returns:
        The old vertex each new one is a copy of, ascending, and the faces in new vertices.
        Vertices without faces are gone; one in the centre of two fans, which is no place of
        a surface, has become two; faces that met at an edge of three or more have parted.

    >>> bow_tie = torch.tensor([[0, 1, 2], [2, 3, 4]])
    >>> vertex_fans(bow_tie)[0]
    tensor([0, 1, 2, 2, 3, 4])
    """
    pairs, ends = face_pairs(faces)
    corners = [
        3 * pairs + (faces[pairs] == end[:, None, None]).long().argmax(dim=2)
        for end in ends.unbind(dim=1)
    ]
    label = graph_components(torch.cat(corners), 3 * len(faces))
    old = torch.empty_like(label[: int(label.max()) + 1]).scatter(0, label, faces.flatten())
    order = old.argsort(stable=True)
    rank = torch.empty_like(order).scatter(0, order, torch.arange(len(order)).to(order))
    return old[order], rank[label].reshape(-1, 3)


def boundary_loops(
    faces: Int[Tensor, "face 3"],
) -> tuple[Int[Tensor, "edge 2"], Int[Tensor, " edge"]]:
    """Follow the border of a surface: every opening, and every rim, is one loop.

    Openings that meet in a vertex are one, as nothing holds the surface together there. An edge
    of three faces or more is border of them all.

    Returns:
        The border's edges, and the loop each is part of, counted from 0.

    >>> cone = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1]])
    >>> boundary_loops(cone)
    (tensor([[1, 2],
            [1, 3],
            [2, 3]]), tensor([0, 0, 0]))
    """
    edges, index = face_edges(faces)
    open_ends = edges[torch.bincount(index.flatten(), minlength=len(edges)) != 2]
    if len(open_ends) == 0:
        return open_ends, open_ends[:, 0]
    on_border = torch.zeros(int(faces.max()) + 1, dtype=torch.bool, device=faces.device)
    on_border[open_ends.flatten()] = True
    source, parted = vertex_fans(faces[on_border[faces].any(dim=1)])
    edges, index = face_edges(parted)
    alone = torch.bincount(index.flatten(), minlength=len(edges)) == 1
    border = edges[alone & on_border[source[edges]].all(dim=1)]
    label = graph_components(border, len(source))[border[:, 0]]
    return source[border], torch.unique(label, return_inverse=True)[1]


def graph_components(links: Int[Tensor, "link 2"], count: int) -> Int[Tensor, " node"]:
    """Label the nodes of a graph that links connect."""
    one, other = links.cpu().numpy().T
    graph = coo_array((one >= 0, (one, other)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    return torch.from_numpy(label).to(links)
