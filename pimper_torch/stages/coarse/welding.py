"""Merging of vertices at the same position, which STL and texture seams duplicate."""

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from pimper_torch.geometry.topology import first_of_each, graph_components
from pimper_torch.records.shapes import Faces, Vertices

# Maximum distance of merged vertices, as a fraction of the diagonal. A choice: rounding in single
# precision and in text of seven digits is below, edges of any mesh of an object are far above.
TOLERANCE = 1e-6


def welded(vertices: Vertices, faces: Faces) -> tuple[Float[Tensor, "kept 3"], Faces]:
    """Merge vertices closer than a millionth of the diagonal; drop vertices without faces.

    Returns:
        The first vertex at each position, in order, and all faces, which may now repeat a vertex.
        A mesh without duplicates is unchanged.

    >>> corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    >>> welded(corners, torch.tensor([[0, 1, 2], [3, 4, 5]]))[1]
    tensor([[0, 1, 2],
            [1, 3, 2]])
    """
    used, faces = torch.unique(faces, return_inverse=True)
    vertices = vertices[used]
    if len(vertices) == 0:
        return vertices, faces
    label = _cluster(vertices.detach().cpu().double()).to(faces.device)
    first = first_of_each(label[:, None])
    new_index = torch.empty_like(first).scatter(0, label[first], torch.arange(len(first)).to(first))
    return vertices[first], new_index[label][faces]


def _cluster(vertices: Vertices) -> Int[Tensor, " vertex"]:
    """Label vertices by position: one label for a cell of a fine grid, and for close cells."""
    low = vertices.amin(dim=0)
    tolerance = TOLERANCE * float((vertices.amax(dim=0) - low).norm())
    if tolerance == 0:
        return torch.zeros(len(vertices), dtype=torch.long)
    # A cell's diagonal is within the tolerance, and its three indices fit in 63 bits.
    x, y, z = ((vertices - low) / (tolerance / 2)).floor().long().unbind(dim=1)
    _, cell = torch.unique((x << 42) | (y << 21) | z, return_inverse=True)
    of_cell = torch.empty(int(cell.max()) + 1, dtype=torch.long)
    of_cell[cell] = torch.arange(len(vertices))
    close = cKDTree(vertices[of_cell].numpy()).query_pairs(tolerance, output_type="ndarray")
    if len(close) == 0:
        return cell
    return graph_components(torch.from_numpy(close).long(), len(of_cell))[cell]
