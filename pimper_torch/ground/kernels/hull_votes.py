"""The vote of silhouettes on the voxels of their visual hull."""

import numpy as np
from numpy.typing import NDArray

from pimper_torch.ground.kernels.compile import compiled

Array = NDArray[np.float32]

# Words are rounded: a tie is the object's.
_TIE = 1e-4


@compiled("void(float32[:,::1], float32[:,::1], float64, float64, float64, float32[:,::1])")
def vote(
    distance: Array,
    word: Array,
    unseen: float,
    disagreeing: float,
    min_seen: float,
    found: Array,
) -> None:
    """Find each voxel's smallest distance to a silhouette after those that are outvoted.

    Args:
        distance: Of each view's silhouette, negative outside; ``unseen`` where a view abstains.
        word: How much each view counts.
        disagreeing: Fraction of the views that do not abstain whose words together are outvoted.
        min_seen: Fraction of the views that may not abstain.
        found: Set: by these words, and were all of them 1; minus infinity where more abstain.
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
            # Of a sorted list that holds more than may be outvoted, the last tells nothing.
            if length > 0 and total > disagreeing * views + _TIE and value >= nearest[length - 1]:
                continue
            place = length
            while place > 0 and nearest[place - 1] > value:
                nearest[place], counts[place] = nearest[place - 1], counts[place - 1]
                place -= 1
            nearest[place], counts[place] = value, word[view, voxel]
            total += counts[place]
            length += 1
            while total - counts[length - 1] > disagreeing * views + _TIE:
                length -= 1
                total -= counts[length]
        found[:, voxel] = -np.inf
        if seen > 0 and seen >= min_seen * views:
            place, outvoted = 0, counts[0]
            while place < length - 1 and outvoted <= disagreeing * seen + _TIE:
                place += 1
                outvoted += counts[place]
            found[0, voxel] = nearest[place]
            found[1, voxel] = nearest[min(int(disagreeing * seen + _TIE), length - 1)]
