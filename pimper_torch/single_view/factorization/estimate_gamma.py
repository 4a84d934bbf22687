r"""Radiometric self-calibration: the gamma for which first-order light fits the photographs best.

The radiance of the same samples in several views under different lights is a matrix of rank 3
(distant point lights) or 4 (with ambient light); with a wrong response it is not. For each
exponent, the residual is computed in encoded values, where the noise is,

.. math:: e = M - (L R)^{1/\gamma}, \qquad f(\gamma) = \min_{L, R} \sum \rho(e),

and is therefore comparable between exponents. A residual in radiance, even relative to radiance,
is not: ``M ** gamma`` tends to a matrix of ones, of rank 1, as gamma decreases. To first order,
noise adds its variance times the degrees of freedom to ``f`` for any exponent, without a shift.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from scipy.optimize import minimize_scalar
from torch import Tensor

from pimper_torch.linalg import robust
from pimper_torch.radiometry import SATURATED, Gamma, Linear, Response, Srgb
from pimper_torch.records import Record, Views
from pimper_torch.records.shapes import Mask
from pimper_torch.runtime.errors import InputError
from pimper_torch.single_view.factorization import low_rank
from pimper_torch.stages.photometry.variable_projection import solve_variable_projection

Samples = Float[Tensor, "view sample"]
Seen = Bool[Tensor, "view sample"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class EncodedFit(Record):
    """Encoded values of the same samples in several views, and a fit of first-order light.

    Attributes:
        scale: Scale of Cauchy's loss; 0 for least squares.
        predicted: Values of the fit; initially the encoded values.
        weight: Weight of each entry, less for outliers; 0 where not used.
        left: Left factor.
    """

    encoded: Samples
    used: Seen
    scale: float
    predicted: Samples
    weight: Samples
    left: Float[Tensor, "view rank"]

    @property
    def loss(self) -> Samples:
        """Loss of each entry; 0 where not used."""
        square = (self.used * (self.encoded - self.predicted)).square()
        return self.scale**2 * (square / self.scale**2).log1p() if self.scale else square

    @property
    def freedom(self) -> int:
        """The residual degrees of freedom."""
        lines = sum(int(self.used.any(dim=axis).sum()) for axis in (0, 1))
        rank = self.left.shape[1]
        return int(self.used.sum()) - rank * (lines - rank)

    @property
    def spread(self) -> float:
        """The residuals' robust standard deviation, corrected for the degrees of freedom."""
        residual = (self.encoded - self.predicted)[self.used]
        size = float(robust.robust_deviation(residual, residual.isfinite()))
        return size * (len(residual) / max(self.freedom, 1)) ** 0.5


def fit_encoded(start: EncodedFit, response: Response, iterations: int = 1) -> EncodedFit:
    """Fit first-order light to encoded values through a response; constant to autograd.

    The encoded residual is linearized about the start, a fit of a similar response, and then about
    the new fit: least squares in radiance, weighted by the square of the response's slope.

    Args:
        iterations: Number of further linearizations about the fit, with outlier weights.
    """
    about, weight, left = start.predicted, start.used * start.weight, start.left
    for iteration in range(iterations + 1):
        linear, rate = robust.with_slope(response.linear_from_encoded, about)
        target = linear + rate * (start.encoded - about)
        heavy = weight / rate.square()
        matrix = low_rank.low_rank_problem(target[None], (heavy / heavy.max())[None], left[None])
        solved = solve_variable_projection(matrix, 30, 1e-7)
        left = solved.lights[0]
        about = response.encoded_from_linear(left @ solved.shading[0]).clamp_min(0.02)
        if iteration < iterations:
            scale = torch.tensor(start.scale).to(about)
            weight = start.used * robust.cauchy_weights(start.encoded - about, scale)
    return start.replace(predicted=about, weight=weight, left=left)


def enough(used: Seen, rank: int) -> Seen:
    """Return the entries without samples and views that have too few to constrain the factors."""
    for _ in range(2):
        used = used & (used.sum(dim=0) > rank) & (used.sum(dim=1, keepdim=True) > 2 * rank)
    return used


# The values below are chosen by hand.
# Range of the search, which contains all curves in use; 1 is linear.
MIN_GAMMA, MAX_GAMMA = 0.4, 4.0
# Number of exponents of the grid search, evenly spaced in their logarithm by factors of 1.4.
_TRIALS = 8
_STEP = (MAX_GAMMA / MIN_GAMMA) ** (1 / (_TRIALS - 1))

# Maximum relative standard error; twice as much would not distinguish 1.8 from 2.2.
_MAX_UNCERTAIN = 0.1

# Maximum residual, four levels of 255; above it there are shadows, highlights, or another curve.
_MAX_RESIDUAL = 0.015

# Encoded value below which shading is not first-order.
_DARK = 0.1

# Minimum scale of Cauchy's loss, an eighth of a level of 8 bits.
_MIN_SCALE = 5e-4

# The estimate is checked without these fractions of the darkest entries.
_DARKEST_FRACTIONS = (1 / 3, 1 / 2)
# Number of standard errors above which a deviating estimate from brighter entries is used.
_MAX_ERRORS = 3.0


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class GammaEstimate(Record):
    """The estimated exponent of a gamma curve, ``radiance = encoded ** gamma``.

    Attributes:
        standard_error: Of gamma, from its variation over samples, or over views if larger.
        determined: False if the standard error is more than a tenth of gamma, the minimum is at an
            end of the range, or residuals exceed the noise of cameras.
        residual: Robust standard deviation of the residuals in encoded values; 1 is full scale.
    """

    gamma: float
    standard_error: float
    determined: bool
    residual: float
    residual_linear: float
    residual_srgb: float
    entries: int

    def __str__(self) -> str:
        """Return the estimate in a sentence."""
        estimate = (
            f"gamma {self.gamma:.3f} +- {self.standard_error:.3f}; residual "
            f"{100 * self.residual:.2f} % of full scale, {100 * self.residual_linear:.2f} % if "
            f"linear, {100 * self.residual_srgb:.2f} % if sRGB"
        )
        if self.determined:
            return f"{estimate}."
        reason = "light or surfaces vary too little"
        if self.residual > _MAX_RESIDUAL:
            reason = "residuals are large: shadows, highlights, a moved camera, or another curve"
        return f"gamma is not determined by these photographs; {reason} ({estimate})."


def estimate_gamma(encoded: Samples, seen: Seen, *, rank: int = 4) -> GammaEstimate:
    """Estimate gamma from the same surface samples under several lights.

    Dark and saturated values are excluded: first by observed values, then by predictions of the
    fit, because selection by noisy values biases gamma. Outliers lose weight. A significantly
    different estimate from brighter entries is preferred, as attached shadows need a higher order.

    Args:
        encoded: Values as in the files; 1 is full scale.
        seen: False for missing values. Dark and saturated values may be included.
        rank: 3 for distant point lights only, 4 with ambient light.

    Raises:
        InputError: Values outside [0, 1], an impossible rank, or too few views or samples for it.

    Constant to autograd.
    """
    if not 1 <= rank <= 9:
        raise InputError(
            f"rank is {rank}; needed: 3 for distant point lights, 4 with ambient light."
        )
    outside = int((seen & ~((encoded >= 0) & (encoded <= 1))).sum())
    if outside:
        raise InputError(
            f"{outside} encoded values are outside 0 to 1; needed: fractions of the files' full "
            "scale, or `seen` false for these values."
        )
    with torch.no_grad():
        fit = _sampled(encoded, seen, rank)
        for _ in range(2):  # the first one still depends on a selection by noisy values
            fit = _selected_by_fit(_grid_search(fit, iterations=0)[1])
        gamma, error, fit = _consistent_minimum(fit)
        certain = _inside_range(gamma) and error < _MAX_UNCERTAIN * gamma
        return GammaEstimate(
            gamma=gamma,
            standard_error=error,
            determined=certain and fit.spread < _MAX_RESIDUAL,
            residual=fit.spread,
            residual_linear=fit_encoded(fit, Linear(), 2).spread,
            residual_srgb=fit_encoded(fit, Srgb(), 2).spread,
            entries=int(fit.used.sum()),
        )


def gamma_of_photographs(views: Views, *, mask: Mask | None = None, rank: int = 4) -> GammaEstimate:
    """Estimate the gamma of photographs that a fixed camera took under several lights.

    Args:
        views: Loaded with :data:`~pimper_torch.radiometry.LINEAR`; masks are intersected.
        mask: True on the object, for all photographs.
    """
    if len(set(map(tuple, views.sizes_px.tolist()))) > 1:
        raise InputError(
            "the photographs have unlike sizes; needed: photographs of one fixed camera."
        )
    inside = views.inside if views.masks is None else views.inside & views.masks
    pixels = inside.all(dim=0)
    if mask is not None:
        if mask.shape != pixels.shape:
            raise InputError(
                f"the mask is {mask.shape[1]} x {mask.shape[0]}, the photographs are "
                f"{pixels.shape[1]} x {pixels.shape[0]}; needed: a mask of the same size."
            )
        pixels = pixels & mask
    encoded = views.images[:, views.images.shape[1] // 2][:, pixels]
    return estimate_gamma(encoded, torch.ones_like(encoded, dtype=torch.bool), rank=rank)


def _sampled(encoded: Samples, seen: Seen, rank: int) -> EncodedFit:
    """Return a start from a subset of the samples, without dark and saturated entries."""
    used = enough(seen & (encoded > _DARK) & (encoded < SATURATED), rank)
    views, samples = used.any(dim=1), used.any(dim=0).nonzero().flatten()
    if int(views.sum()) <= rank + 1 or len(samples) <= 4 * rank:
        raise InputError(
            f"only {len(samples)} samples are lit in more than {rank} of {len(seen)} views; "
            f"needed: more than {4 * rank}, in at least {rank + 2} views. Add photographs under "
            "other lights, expose so that fewer pixels are dark or saturated, or lower the rank."
        )
    count = min(300, len(samples))
    spaced = torch.linspace(0, len(samples) - 1, count, dtype=torch.float64).round().long()
    subset = samples[spaced.to(samples.device)]
    used = enough(used[views][:, subset], rank)
    return _start(torch.where(seen, encoded, 0)[views][:, subset].double(), used, rank, 0.0)


def _start(encoded: Samples, used: Seen, rank: int, scale: float) -> EncodedFit:
    """Return a start from the encoded values, with the left factor for the smallest gamma."""
    mask, about = used.double(), torch.where(used, encoded, 0.5)
    radiance = Gamma(exponent=MIN_GAMMA).linear_from_encoded(about)
    guess = low_rank.brightness_guess(radiance, mask)[None]
    left = low_rank.singular_left(radiance[None], mask[None], rank, guess, 29)[0]
    return EncodedFit(
        encoded=encoded, used=used, scale=scale, predicted=about, weight=mask, left=left
    )


def _selected_by_fit(fit: EncodedFit) -> EncodedFit:
    """Return a start from entries predicted to be lit and not saturated, with outlier weights."""
    encoded, predicted, rank = fit.encoded, fit.predicted, fit.left.shape[1]
    lit = (predicted > _DARK) & (encoded > _DARK / 2)  # far below: cast shadow; 0: missing
    lit = lit & (predicted < SATURATED - _DARK / 2) & (encoded < SATURATED)
    used = enough(lit & (fit.used.sum(dim=0) > rank), rank)
    if int(used.any(dim=0).sum()) <= 4 * rank:
        used = fit.used
    residual = (encoded - predicted)[used]
    scale = robust.CAUCHY_TUNING * float(robust.robust_deviation(residual, residual.isfinite()))
    return _start(encoded, used, rank, max(scale, _MIN_SCALE))


def _grid_search(fit: EncodedFit, iterations: int) -> tuple[float, EncodedFit]:
    fits = []
    for trial in range(_TRIALS):
        gamma = MIN_GAMMA * _STEP**trial
        fit = fit_encoded(fit, Gamma(exponent=gamma), iterations)
        fits.append((gamma, fit))
    return min(fits, key=lambda pair: float(pair[1].loss.sum()))


def _inside_range(gamma: float) -> bool:
    return MIN_GAMMA * 1.01 < gamma < MAX_GAMMA / 1.01


def _minimise(fit: EncodedFit, low: float, high: float) -> tuple[float, float, EncodedFit]:
    r"""Return the gamma of least loss, its sandwich standard error, and its fit.

    With the derivative :math:`s_k` of the loss of sample (or view) k along the profile, and the
    second derivative h of the total loss, the variance is :math:`\sum_k s_k^2 / h^2`, the larger of
    that over samples and over views; it needs no noise model. Infinite for almost no curvature.
    """

    def loss(logarithm: float) -> float:
        nonlocal fit
        fit = fit_encoded(fit, Gamma(exponent=math.exp(logarithm)))
        return float(fit.loss.sum())

    bounds = (math.log(max(low, MIN_GAMMA)), math.log(min(high, MAX_GAMMA)))
    minimum = minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 1e-4})
    gamma = math.exp(minimum.x)
    fit, step = fit_encoded(fit, Gamma(exponent=gamma)), 0.02 * gamma
    below, above = (
        fit_encoded(fit, Gamma(exponent=value)).loss for value in (gamma - step, gamma + step)
    )
    curvature = float((below + above - 2 * fit.loss).sum()) / step**2
    slope = (above - below) / (2 * step)
    noise = max(float(slope.sum(dim=axis).square().sum()) for axis in (0, 1)) ** 0.5
    # On data without noise, everything except the curvature is rounding error.
    curved = curvature * gamma**2 > (_MIN_SCALE * 0.1) ** 2 * int(fit.used.sum())
    return gamma, noise / curvature if curved else math.inf, fit


def _consistent_minimum(fit: EncodedFit) -> tuple[float, float, EncodedFit]:
    """Return the minimum of all entries, or of the brighter ones if it differs significantly.

    Ambient light in attached shadows is not first-order, and biases the estimate from all entries.
    """
    best, fit = _grid_search(fit, 1)
    minima = [_minimise(fit, best / _STEP, best * _STEP)]
    fit = minima[0][2]
    for fraction in _DARKEST_FRACTIONS:
        threshold = fit.predicted[fit.used].quantile(fraction)
        used = enough(fit.used & (fit.predicted > threshold), fit.left.shape[1])
        if (brighter := fit.replace(used=used)).freedom < 100:  # no reliable standard error
            break
        minima.append(_minimise(brighter, MIN_GAMMA, MAX_GAMMA))
    while any(
        abs(gamma - minima[0][0]) > _MAX_ERRORS * error + 1e-3 * minima[0][0]
        for gamma, error, _ in minima[1:]
        if _inside_range(gamma)
    ):
        minima = minima[1:]
    return minima[0]
