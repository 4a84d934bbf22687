"""Whether a surface is as far off as it says: expected against true error."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.stats import spearmanr
from torch import Tensor

from pimper_torch.records import Record

_BINS = 10

# Median of the absolute value of unit Gaussian noise.
_MEDIAN_OF_ONE = 0.6745


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationBin(Record):
    """A tenth of the surface, by expected error; scene units.

    Attributes:
        expected: Root mean square of the expected errors.
        robust: Median of the true errors over 0.6745, the standard deviation that Gaussian
            noise of this median has: blind to outliers.
    """

    expected: float
    root_mean_square: float
    robust: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration(Record):
    """How expected errors compare with true ones.

    Attributes:
        ratio: Median of true over expected error, over 0.6745: 1 for Gaussian noise of the
            expected standard deviation, more where the surface is too sure of itself.
        within_one: Share with a true error up to the expected one; 68 % for Gaussian noise.
        within_two: Share with one up to twice the expected one; 95 %.
        rank_correlation: Spearman's, between expected and true errors; NaN if all expected ones
            are the same.
        bins: Of equal fractions of the surface, by rising expected error.
    """

    ratio: float
    within_one: float
    within_two: float
    rank_correlation: float
    bins: tuple[CalibrationBin, ...]
    samples: int


def calibrate(
    expected: Float[Tensor, " sample"], true: Float[Tensor, " sample"]
) -> Calibration | None:
    """Compare expected with true errors over samples of equal area.

    Args:
        expected: Standard errors, scene units.
        true: Distances to the truth, scene units.

    Returns:
        ``None`` if fewer than ten samples have a finite expected error above 0.
    """
    known = expected.isfinite() & (expected > 0)
    expected, true = expected[known].double().cpu(), true[known].double().cpu()
    if len(expected) < _BINS:
        return None
    fraction = true / expected
    order = expected.argsort()
    varied = bool(expected.min() < expected.max())
    correlation = spearmanr(expected.numpy(), true.numpy()).statistic if varied else math.nan
    return Calibration(
        ratio=float(fraction.median()) / _MEDIAN_OF_ONE,
        within_one=float((fraction <= 1).double().mean()),
        within_two=float((fraction <= 2).double().mean()),
        rank_correlation=float(correlation),
        bins=tuple(
            CalibrationBin(
                expected=float(expected[one].square().mean().sqrt()),
                root_mean_square=float(true[one].square().mean().sqrt()),
                robust=float(true[one].median()) / _MEDIAN_OF_ONE,
            )
            for one in torch.tensor_split(order, _BINS)
        ),
        samples=len(expected),
    )
