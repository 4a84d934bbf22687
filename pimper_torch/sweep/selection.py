"""Which views a sample is compared in."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


def best_views(
    score: Float[Tensor, "sample view"], usable: Bool[Tensor, "sample view"], count: int
) -> tuple[Int[Tensor, "sample chosen"], Bool[Tensor, "sample chosen"]]:
    """Choose, for every sample, the usable views of the best scores, ``count`` of them at most.

    Returns:
        The views, and which entries are no padding: a sample with fewer usable ones has fewer.

    >>> score = torch.tensor([[0.5, 0.9, 0.7]])
    >>> best_views(score, torch.tensor([[True, True, False]]), 2)
    (tensor([[1, 0]]), tensor([[True, True]]))
    """
    rated = torch.where(usable, score, -torch.inf)
    best = rated.topk(min(count, score.shape[1]), dim=1)
    return best.indices, best.values > -torch.inf


def poses_first(
    score: Float[Tensor, "sample view"],
    usable: Bool[Tensor, "sample view"],
    poses: Int[Tensor, " view"],
) -> Float[Tensor, "sample view"]:
    """Rate the best usable view of every pose before the second of any, and so on.

    Views of one pose say nothing of a height: they agree whatever it is.

    Args:
        score: In [0, 1].

    Returns:
        The score, less the number of better views of the same pose.

    >>> score, poses = torch.tensor([[0.9, 0.8, 0.3]]), torch.tensor([0, 0, 1])
    >>> poses_first(score, torch.ones(1, 3, dtype=torch.bool), poses)
    tensor([[ 0.9000, -0.2000,  0.3000]])
    """
    rated = torch.where(usable, score, -torch.inf)
    found = score.clone()
    for pose in sorted(set(poses.tolist())):
        (own,) = torch.nonzero(poses == pose, as_tuple=True)
        order = rated[:, own].argsort(dim=1, descending=True, stable=True)
        found[:, own] -= order.argsort(dim=1)
    return found


def view_scores(
    facing: Float[Tensor, "sample view"],
    footprint: Float[Tensor, "sample view"],
    shading: Float[Tensor, "sample view"],
) -> Float[Tensor, "sample view"]:
    """Rate views by angle, resolution and light.

    Args:
        facing: Cosine between the normal and the way to the camera.
        footprint: Pixels that a sample spans, if it faced the camera; more than one is no
            better than one.
        shading: What the light makes of albedo 1 there.

    A view that sees the surface straight on and finely, in the light of a good view, has 1.
    """
    typical = shading.clamp_min(0).mean(dim=1, keepdim=True)
    lit = shading / torch.where(typical > 0, typical, 1)
    return facing * footprint.clamp_max(1) * lit.clamp(0, 1)
