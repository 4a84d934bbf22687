"""What hangs together in a triangle mesh. Graphs are searched by scipy, on the CPU."""

import torch
from jaxtyping import Bool, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from pimper_torch.geometry.surfaces import face_pairs


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


def vertex_fans(
    faces: Int[Tensor, "face 3"],
) -> tuple[Int[Tensor, " fan"], Int[Tensor, "face 3"]]:
    """Give every fan of faces round a vertex a vertex of its own.

    Returns:
        The old vertex each new one is a copy of, ascending, and the faces in new vertices.
        Vertices without faces are gone; one in the middle of two fans, which is no place of
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


def graph_components(links: Int[Tensor, "link 2"], count: int) -> Int[Tensor, " node"]:
    """Label the nodes of a graph that links connect."""
    one, other = links.cpu().numpy().T
    graph = coo_array((one >= 0, (one, other)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    return torch.from_numpy(label).to(links)
