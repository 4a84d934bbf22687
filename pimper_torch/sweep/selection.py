"""Which views judge a sample."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def best_views(
    score: Float[Tensor, "patch view height width"],
    usable: Bool[Tensor, "patch view height width"],
    count: int,
) -> Bool[Tensor, "patch view height width"]:
    """Keep, at every sample, the usable views of the best scores, ``count`` of them at most.

    >>> score = torch.tensor([0.5, 0.9, 0.7]).reshape(1, 3, 1, 1)
    >>> best_views(score, torch.ones(1, 3, 1, 1, dtype=torch.bool), 2).flatten()
    tensor([False,  True,  True])
    """
    if score.shape[1] <= count:
        return usable
    rated = torch.where(usable, score, -torch.inf)
    chosen = rated.topk(count, dim=1).indices
    kept = torch.zeros_like(usable).scatter(1, chosen, value=True)
    return kept & usable
