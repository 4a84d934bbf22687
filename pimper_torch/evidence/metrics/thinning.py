"""Point clouds of even density: no two points nearer than a distance."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

# The fewest points visited at once.
_BATCH = 100_000


def thin(
    points: Float[Tensor, "point 3"], distance: float, generator: torch.Generator
) -> Int[Tensor, " kept"]:
    """Visit points in random order; keep each that no kept point is within ``distance`` of.

    Exactly what visiting one by one gives, done in batches: a batch is first cleared of what
    earlier points forbid, then settled among itself.

    Args:
        points: On the CPU.
        distance: Two kept points are farther apart than this.
        generator: On the CPU.

    Returns:
        Indices of the kept points, in the order they were visited.

    Source: Jensen et al., CVPR 2014, supplementary code.
    """
    positions = points.detach().cpu().double()
    order = torch.randperm(len(positions), generator=generator)
    kept = order[:0]
    while len(order):
        # As large as what is kept, so that few trees are built.
        batch, order = order.tensor_split([max(_BATCH, len(kept))])
        if len(kept):
            nearest, _ = cKDTree(positions[kept].numpy()).query(
                positions[batch].numpy(), distance_upper_bound=np.nextafter(distance, np.inf)
            )
            batch = batch[torch.from_numpy(nearest > distance)]
        kept = torch.cat([kept, batch[_settled(positions[batch], distance)]])
    return kept


def _settled(positions: Float[Tensor, "point 3"], distance: float) -> Bool[Tensor, " point"]:
    """Keep each point, first to last, that no kept one before it is near.

    A round keeps the points that no undecided point before them is near, and drops the
    neighbours of what it kept; what is kept is the same as one by one.
    """
    undecided = np.ones(len(positions), dtype=bool)
    kept = np.zeros(len(positions), dtype=bool)
    pairs = cKDTree(positions.numpy()).query_pairs(distance, output_type="ndarray")
    first, second = np.sort(pairs, axis=1).T
    while undecided.any():
        preceded = np.zeros(len(positions), dtype=bool)
        preceded[second] = True
        chosen = undecided & ~preceded
        kept |= chosen
        undecided &= ~chosen
        undecided[second[chosen[first]]] = False
        open_pairs = undecided[first] & undecided[second]
        first, second = first[open_pairs], second[open_pairs]
    return torch.from_numpy(kept)
