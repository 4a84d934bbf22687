"""Error of albedo, which photographs tell up to scale only."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from pimper_torch.records import Record


@dataclass(frozen=True, slots=True, kw_only=True)
class AlbedoFigures(Record):
    """Errors after a scale was fitted: one for all channels, or one a channel.

    Attributes:
        one_scale_percent: ``100 ||s a - t|| / ||t||`` over samples and channels, with the
            scale ``s`` of least squares.
        channel_scales_percent: The same with one such scale a channel, which forgives the
            colour of the lights.
        one_scale_median_percent: Median of ``100 |s a - t| / t``, with ``s`` the median of
            ``t / a``: blind to outliers.
        channels: Compared; 1 if either side is grey, whose other side is then averaged.
    """

    one_scale_percent: float
    channel_scales_percent: float
    one_scale_median_percent: float
    channels: int
    samples: int


def compare_albedo(
    albedo: Float[Tensor, "sample ours"], albedo_true: Float[Tensor, "sample theirs"]
) -> AlbedoFigures | None:
    """Compare albedo sample by sample, up to scale.

    Args:
        albedo: Linear, up to scale.
        albedo_true: Linear.

    Returns:
        ``None`` if no sample has both: finite, and above zero in the sum of its channels.
    """
    ours, truth = albedo.cpu().double(), albedo_true.cpu().double()
    if ours.shape[1] != truth.shape[1]:
        ours, truth = ours.mean(dim=1, keepdim=True), truth.mean(dim=1, keepdim=True)
    known = ours.isfinite().all(dim=1) & truth.isfinite().all(dim=1)
    known &= (ours.sum(dim=1) > 0) & (truth.sum(dim=1) > 0)
    if not bool(known.any()):
        return None
    ours, truth = ours[known], truth[known]
    one = (ours * truth).sum() / ours.square().sum()
    each = (ours * truth).sum(dim=0) / ours.square().sum(dim=0).clamp_min(1e-300)
    positive = (ours > 0) & (truth > 0)
    there, here = truth[positive], ours[positive]
    robust = (there / here).median()
    return AlbedoFigures(
        one_scale_percent=float(100 * (one * ours - truth).norm() / truth.norm()),
        channel_scales_percent=float(100 * (each * ours - truth).norm() / truth.norm()),
        one_scale_median_percent=float(100 * ((robust * here - there).abs() / there).median()),
        channels=ours.shape[1],
        samples=len(ours),
    )
