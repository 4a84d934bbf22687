"""Views whose depth lies behind points (free-space violations): twin of ``oriented.denied``."""

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels.compile import compiled


@compiled(
    "void(float32[:,::1], int64, float32[:,:,::1], float32[:,:,::1], boolean[:,:,::1], "
    "float32[::1], int64[::1])"
)
def count_denied(
    points: NDArray[np.float32],
    view: int,
    pixels_from_world: NDArray[np.float32],
    inverse_depth: NDArray[np.float32],
    valid: NDArray[np.bool_],
    slack: NDArray[np.float32],
    counts: NDArray[np.int64],
) -> None:
    """Count, for each point, the other views with a valid depth behind it.

    Args:
        points: World, ``point 3``.
        view: That is left out.
        pixels_from_world: Homogeneous, ``view 3 4``.
        inverse_depth: ``view height width``.
        valid: Of the same shape.
        slack: Of inverse depth that does not count, one a view.
        counts: Filled in, one a point.
    """
    num_views, height, width = inverse_depth.shape
    counts[:] = 0
    for other in range(num_views):
        if other == view:
            continue
        to = pixels_from_world[other]
        for index in range(len(points)):
            x, y, z = points[index, 0], points[index, 1], points[index, 2]
            depth = to[2, 0] * x + to[2, 1] * y + to[2, 2] * z + to[2, 3]
            if depth <= 0:
                continue
            nearness = np.float32(1) / depth
            u = (to[0, 0] * x + to[0, 1] * y + to[0, 2] * z + to[0, 3]) * nearness
            v = (to[1, 0] * x + to[1, 1] * y + to[1, 2] * z + to[1, 3]) * nearness
            if 0 <= u < width and 0 <= v < height:
                row, column = np.uint32(v), np.uint32(u)
                if valid[other, row, column]:
                    behind = inverse_depth[other, row, column] + slack[other]
                    counts[index] += nearness > behind
