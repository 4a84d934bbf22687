"""How far neighbouring height fields are apart, and which patches meet a neighbour."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.records import AlignStatus

# Height fields this close, in edge lengths, agree.
SAME_PLACE = 5e-3

# A seam that fewer rays than this fraction meet says nothing of its patches.
_MET_ENOUGH = 0.25


def common_distance(
    distance: Float[Tensor, "*sample"], met: Bool[Tensor, "*sample"]
) -> Float[Tensor, ""]:
    """Return the distance that half of all samples stay below, at least ``SAME_PLACE``."""
    return distance[met].median().clamp_min(SAME_PLACE)


def patch_status(
    facets: Int[Tensor, "seam 2"], met: Bool[Tensor, "seam ray"], count: int
) -> Int[Tensor, " face"]:
    """Assign every patch its :class:`~pimper_torch.records.AlignStatus`."""
    overlapping = met.sum(dim=1) >= _MET_ENOUGH * met.shape[1]
    status = torch.full((count,), int(AlignStatus.ALONE), device=facets.device)
    status[facets[overlapping].flatten()] = int(AlignStatus.ALIGNED)
    return status
