"""Connected components of vertices, and how far they extend."""

from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.geometry.topology import vertex_components


def small_groups(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    among: Bool[Tensor, " vertex"],
    max_extent: Float[Tensor, ""],
) -> Bool[Tensor, " vertex"]:
    """Find the vertices ``among`` whose connected component is small.

    Args:
        among: Vertices to connect along edges.
        max_extent: Diagonal of a component's bounding box.
    """
    label = vertex_components(faces, among)
    count = int(label.max()) + 1 if len(label) else 0
    index = label[:, None].expand_as(vertices)
    like = vertices.new_zeros(count, 3)
    high = like.scatter_reduce(0, index, vertices, "amax", include_self=False)
    low = like.scatter_reduce(0, index, vertices, "amin", include_self=False)
    small = (high - low).norm(dim=-1) <= max_extent
    return among & small[label]


def diagonal(vertices: Float[Tensor, "vertex 3"]) -> Float[Tensor, ""]:
    """Return the diagonal of the points' bounding box."""
    return (vertices.amax(dim=0) - vertices.amin(dim=0)).norm()
