"""Which samples of an overlap can be believed, and which patches neighbours bear out."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.records import AlignStatus

# Reliefs this close, in edge lengths, agree; only beyond it can a sample be an outlier.
SAME_PLACE = 5e-3

# A seam whose samples keep less of their weight than this on average bears nobody out: it is
# what a sample at the outlier's distance keeps.
_RELIABLE = 0.25

# A seam that fewer rays than this fraction meet says nothing of its patches.
_MET_ENOUGH = 0.25


def common_distance(
    distance: Float[Tensor, "*sample"], met: Bool[Tensor, "*sample"]
) -> Float[Tensor, ""]:
    """Return the distance that half of all samples stay below, at least ``SAME_PLACE``."""
    return distance[met].median().clamp_min(SAME_PLACE)


def trust_by_distance(
    distance: Float[Tensor, "seam ray"], met: Bool[Tensor, "seam ray"], outlier: float
) -> Float[Tensor, "seam ray"]:
    """Weight samples down that are apart by far more than most.

    Args:
        distance: Between the two height fields.
        met: Where it means something.
        outlier: A sample this many times the median apart keeps a quarter of its weight
            (Geman and McClure's function).
    """
    # An infinite limit comes first: its product with a distance would have no derivative.
    return (1 + (distance / outlier / common_distance(distance, met)).square()) ** -2


def overlapping_seams(met: Bool[Tensor, "seam ray"]) -> Bool[Tensor, " seam"]:
    """Find the seams whose two height fields lie over each other for enough of their length."""
    return met.sum(dim=1) >= _MET_ENOUGH * met.shape[1]


def reliable_seams(
    reliability: Float[Tensor, "seam ray"], met: Bool[Tensor, "seam ray"]
) -> Bool[Tensor, " seam"]:
    """Find the overlapping seams whose two height fields lie in the same place."""
    mean = (reliability * met).sum(dim=1) / met.sum(dim=1).clamp_min(1)
    return overlapping_seams(met) & (mean >= _RELIABLE)


def judge_patches(
    facets: Int[Tensor, "seam 2"],
    overlapping: Bool[Tensor, " seam"],
    reliable: Bool[Tensor, " seam"],
    count: int,
) -> Int[Tensor, " face"]:
    """Assign every patch its :class:`~pimper_torch.records.AlignStatus`.

    Args:
        overlapping: Whether their height fields lie over each other.
    """
    status = torch.full((count,), int(AlignStatus.ALONE), device=facets.device)
    status[facets[overlapping].flatten()] = int(AlignStatus.DISPUTED)
    status[facets[overlapping & reliable].flatten()] = int(AlignStatus.ALIGNED)
    return status
