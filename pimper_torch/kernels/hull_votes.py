"""The vote of silhouettes on the voxels of their visual hull."""

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels.compile import compiled

Array = NDArray[np.float32]

# Weights are rounded: a tie counts as object.
_TIE = 1e-4


@compiled("void(float32[:,::1], float32[:,::1], float64, float64, float64, float32[:,::1])")
def vote(
    distance: Array,
    weight: Array,
    unseen: float,
    disagreeing: float,
    min_seen: float,
    smallest: Array,
) -> None:
    """Compute each voxel's smallest distance to a silhouette, without the views outvoted.

    Args:
        distance: To each view's silhouette, negative outside; ``unseen`` where a view abstains.
        weight: Of each view.
        disagreeing: Maximum sum of outvoted weights, as a fraction of the views not abstaining.
        min_seen: Minimum fraction of views that do not abstain.
        smallest: Result: with these weights, and with all 1; minus infinity where more abstain.
    """
    views, voxels = distance.shape
    nearest, counts = np.empty(views + 1, np.float32), np.empty(views + 1, np.float32)
    for voxel in range(voxels):
        length, seen, total = 0, 0, 0.0
        for view in range(views):
            value = distance[view, voxel]
            if value >= unseen:
                continue
            seen += 1
            # If the sorted list has more weight than can be outvoted, larger values are ignored.
            if length > 0 and total > disagreeing * views + _TIE and value >= nearest[length - 1]:
                continue
            slot = length
            while slot > 0 and nearest[slot - 1] > value:
                nearest[slot], counts[slot] = nearest[slot - 1], counts[slot - 1]
                slot -= 1
            nearest[slot], counts[slot] = value, weight[view, voxel]
            total += counts[slot]
            length += 1
            while total - counts[length - 1] > disagreeing * views + _TIE:
                length -= 1
                total -= counts[length]
        smallest[:, voxel] = -np.inf
        if seen > 0 and seen >= min_seen * views:
            slot, outvoted = 0, counts[0]
            while slot < length - 1 and outvoted <= disagreeing * seen + _TIE:
                slot += 1
                outvoted += counts[slot]
            smallest[0, voxel] = nearest[slot]
            smallest[1, voxel] = nearest[min(int(disagreeing * seen + _TIE), length - 1)]
