r"""Radiometric self-calibration: the gamma under which first-order light fits the photographs.

Views of the same samples under several lights are, as radiance, a matrix of rank 3 (distant
point lights) or 4 (ambient light besides); under a wrong response they are not. For each exponent
the residual is that of the encoded values, where the noise is,

.. math:: e = M - (L R)^{1/\gamma}, \qquad f(\gamma) = \min_{L, R} \sum \rho(e),

so that it is comparable over exponents. A residual in radiance, even relative to radiance
itself, is not: ``M ** gamma`` tends to a matrix of ones, which is of rank 1, as gamma falls.
To first order noise adds to ``f`` its variance times the degrees of freedom, whatever the
exponent, and does not shift the minimum.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from scipy.optimize import minimize_scalar
from torch import Tensor

from pimper_torch.ground.linalg.robust import (
    CAUCHY_TUNING,
    cauchy_weights,
    robust_deviation,
    with_slope,
)
from pimper_torch.ground.radiometry import SATURATED, Gamma, Linear, Response, Srgb
from pimper_torch.ground.shapes import Mask
from pimper_torch.method.photometry.variable_projection import solve_variable_projection
from pimper_torch.records import Record, Views
from pimper_torch.runtime.errors import InputError
from pimper_torch.single_view.factorization import low_rank


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class EncodedMatrix(Record):
    """Encoded values of the same samples in several views.

    Attributes:
        scale: Of Cauchy's loss; 0 is least squares.
    """

    encoded: Float[Tensor, "view sample"]
    seen: Bool[Tensor, "view sample"]
    used: Bool[Tensor, "view sample"]
    scale: float
    rank: int


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class EncodedFit(Record):
    """The fit under one response.

    Attributes:
        loss: Of each entry; 0 where not used.
        weight: Of each entry, less for outliers.
        left: Left factor, the initial value for the next response.
    """

    predicted: Float[Tensor, "view sample"]
    loss: Float[Tensor, "view sample"]
    weight: Float[Tensor, "view sample"]
    left: Float[Tensor, "view rank"]


def fit_encoded(
    problem: EncodedMatrix, response: Response, start: EncodedFit | None, iterations: int = 1
) -> EncodedFit:
    """Fit first-order light to encoded values through a response; constant to autograd.

    The encoded residual is linearized, first about the values or a former fit, then about the
    fit: it is then least squares in radiance, weighted by the square of the response's slope.

    Args:
        start: Fit of a similar response; ``None`` starts from the values.
        iterations: Further linearizations about the fit, with outlier weights.
    """
    mask = problem.used.double()
    about, weight = torch.where(problem.used, problem.encoded, 0.5), mask
    left: Tensor | None = None
    if start is not None:
        about, weight, left = start.predicted, mask * start.weight, start.left
    for iteration in range(iterations + 1):
        linear, rate = with_slope(response.linear_from_encoded, about)
        target = linear + rate * (problem.encoded - about)
        heavy = weight / rate.square()
        heavy = heavy / heavy.max()
        if left is None:
            guess = low_rank.brightness_guess(target, mask)[None]
            left = low_rank.singular_left(target[None], mask[None], problem.rank, guess, 29)[0]
        matrix = low_rank.low_rank_problem(target[None], heavy[None], left[None])
        solved = solve_variable_projection(matrix, 30, 1e-7)
        left = solved.lights[0]
        about = response.encoded_from_linear(left @ solved.shading[0]).clamp_min(0.02)
        residual = mask * (problem.encoded - about)
        if problem.scale and iteration < iterations:
            weight = mask * cauchy_weights(residual, torch.tensor(problem.scale).to(residual))
    loss = residual.square()
    if problem.scale:
        loss = problem.scale**2 * torch.log1p(loss / problem.scale**2)
    assert left is not None, "there is one round at least"
    return EncodedFit(predicted=about, loss=loss, weight=weight, left=left)


def enough(used: Bool[Tensor, "view sample"], rank: int) -> Bool[Tensor, "view sample"]:
    """Leave out samples and views with too few entries to constrain the factors."""
    for _ in range(2):
        used = used & (used.sum(dim=0) > rank) & (used.sum(dim=1, keepdim=True) > 2 * rank)
    return used


def freedom(used: Bool[Tensor, "view sample"], rank: int) -> int:
    """Count the residual degrees of freedom."""
    views, samples = (int(used.any(dim=axis).sum()) for axis in (1, 0))
    return int(used.sum()) - rank * (views + samples - rank)


def residual_spread(problem: EncodedMatrix, fit: EncodedFit) -> float:
    """Return the residuals' robust standard deviation, corrected for the degrees of freedom."""
    residual = (problem.encoded - fit.predicted)[problem.used]
    size = float(robust_deviation(residual, residual.isfinite()))
    free = max(freedom(problem.used, problem.rank), 1)
    return size * (int(problem.used.sum()) / free) ** 0.5


# Range of the search, a choice: it holds all curves in use; 1 is linear.
MIN_GAMMA, MAX_GAMMA = 0.4, 4.0
# Exponents of the grid search, a choice: even in their logarithm, 1.4 times one another.
_TRIALS = 8

# Maximum relative standard error: a choice, twice as much would not distinguish 1.8 from 2.2.
_MAX_UNCERTAIN = 0.1

# Maximum residual: a choice, four levels of 255; more is shadows, highlights, or another curve.
_MAX_RESIDUAL = 0.015

# Encoded value up to which shading is not first-order.
_DARK = 0.1

# Minimum scale of Cauchy's loss: a choice, an eighth of a level of 8 bits.
_MIN_SCALE = 5e-4

# The estimate is checked without these fractions of the entries, the darkest: a choice.
_DARKEST_FRACTIONS = (1 / 3, 1 / 2)
# Difference from the estimate of the brighter entries, in its standard errors, above which they
# replace the estimate: a choice.
_MAX_ERRORS = 3.0


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class GammaEstimate(Record):
    """The estimated exponent of a gamma curve, ``radiance = encoded ** gamma``.

    Attributes:
        standard_error: Of gamma, from its variation over samples, or views if that is larger.
        determined: False where the standard error is more than a tenth of gamma, the minimum is
            at an end of the range, or residuals exceed a camera's noise.
        residual: Robust standard deviation of the residuals in encoded values, 1 being full scale.
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
        found = (
            f"gamma {self.gamma:.3f} +- {self.standard_error:.3f}; residual "
            f"{100 * self.residual:.2f} % of full scale, {100 * self.residual_linear:.2f} % if "
            f"linear, {100 * self.residual_srgb:.2f} % if sRGB"
        )
        if self.determined:
            return f"{found}."
        why = "light or surfaces vary too little"
        if self.residual > _MAX_RESIDUAL:
            why = "shadows, highlights, another curve or a camera that moved leave more than noise"
        return f"gamma is not determined by these photographs, {why} ({found})."


def estimate_gamma(
    encoded: Float[Tensor, "view sample"], seen: Bool[Tensor, "view sample"], *, rank: int = 4
) -> GammaEstimate:
    """Estimate gamma from the same surface samples under several lights.

    Dark and saturated values are left out: first by their observed values, then by those the fit
    predicts, as selecting by noisy values biases gamma. Outliers lose weight. Where the estimate
    from the brighter entries differs significantly, it is taken: ambient light in attached shadows
    is not first-order.

    Args:
        encoded: As the files hold them, 1 being full scale.
        seen: False where missing. Dark and saturated values may be seen.
        rank: 3 for distant point lights alone, 4 with ambient light.

    Raises:
        InputError: Values outside [0, 1] or not finite, an impossible rank, or fewer
            views or samples than the rank needs.

    Constant to autograd.
    """
    if not 1 <= rank <= 9:
        raise InputError(
            f"rank is {rank}; needed: 3 for distant point lights, 4 with ambient light."
        )
    outside = int((seen & ~((encoded >= 0) & (encoded <= 1))).sum())
    if outside:
        raise InputError(
            f"{outside} encoded values are not from 0 to 1; needed: fractions of the files' full "
            "scale, or `seen` false for these."
        )
    with torch.no_grad():
        problem = _problem(encoded, seen, rank)
        for _ in range(2):  # the first still starts from a selection by noisy values
            problem = _chosen_by_fit(problem, _grid_search(problem, iterations=0)[1].predicted)
        found = _consistent_minimum(problem)
        residual, linear, srgb = (
            residual_spread(found.problem, fit)
            for fit in (
                found.fit,
                fit_encoded(found.problem, Linear(), found.fit, 2),
                fit_encoded(found.problem, Srgb(), found.fit, 2),
            )
        )
        sure = found.inner and found.error < _MAX_UNCERTAIN * found.gamma
        return GammaEstimate(
            gamma=found.gamma,
            standard_error=found.error,
            determined=sure and residual < _MAX_RESIDUAL,
            residual=residual,
            residual_linear=linear,
            residual_srgb=srgb,
            entries=int(found.problem.used.sum()),
        )


def gamma_of_photographs(views: Views, *, mask: Mask | None = None, rank: int = 4) -> GammaEstimate:
    """Estimate the gamma of photographs that a fixed camera took under several lights.

    Args:
        views: Read with :data:`~pimper_torch.ground.radiometry.LINEAR`; pixels that any of their
            masks leaves out are left out.
        mask: True on the object, for all photographs.
    """
    if len(set(map(tuple, views.sizes_px.tolist()))) > 1:
        raise InputError(
            "the photographs have unlike sizes; needed: photographs of one fixed camera."
        )
    inside = views.inside if views.masks is None else views.inside & views.masks
    where = inside.all(dim=0)
    if mask is not None:
        if mask.shape != where.shape:
            raise InputError(
                f"the mask is {mask.shape[1]} x {mask.shape[0]}, the photographs are "
                f"{where.shape[1]} x {where.shape[0]}; needed: a mask of the same size."
            )
        where = where & mask
    encoded = views.images[:, views.images.shape[1] // 2][:, where]
    return estimate_gamma(encoded, torch.ones_like(encoded, dtype=torch.bool), rank=rank)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Minimum(Record):
    """The minimum of the loss over gamma, and its standard error."""

    problem: EncodedMatrix
    gamma: float
    fit: EncodedFit
    error: float

    @property
    def inner(self) -> bool:
        """Whether it is not at an end of the range."""
        return MIN_GAMMA * 1.01 < self.gamma < MAX_GAMMA / 1.01


def _problem(
    encoded: Float[Tensor, "view sample"], seen: Bool[Tensor, "view sample"], rank: int
) -> EncodedMatrix:
    """Subsample, and use entries that are neither dark nor saturated."""
    used = enough(seen & (encoded > _DARK) & (encoded < SATURATED), rank)
    views, samples = used.any(dim=1), used.any(dim=0).nonzero().flatten()
    if int(views.sum()) <= rank + 1 or len(samples) <= 4 * rank:
        raise InputError(
            f"only {len(samples)} samples are lit in more than {rank} of {len(seen)} views; "
            f"needed: more than {4 * rank}, in at least {rank + 2} views. Add photographs under "
            "other lights, expose so that less is dark or saturated, or lower the rank."
        )
    count = min(300, len(samples))
    spaced = torch.linspace(0, len(samples) - 1, count, dtype=torch.float64).round().long()
    chosen = samples[spaced.to(samples.device)]
    return EncodedMatrix(
        encoded=torch.where(seen, encoded, 0)[views][:, chosen].double(),
        seen=seen[views][:, chosen],
        used=enough(used[views][:, chosen], rank),
        scale=0.0,
        rank=rank,
    )


def _chosen_by_fit(
    problem: EncodedMatrix, predicted: Float[Tensor, "view sample"]
) -> EncodedMatrix:
    """Use entries that the fit predicts to be lit and not saturated, with outlier weights."""
    encoded = problem.encoded
    known = problem.seen & (problem.used.sum(dim=0) > problem.rank)
    lit = (predicted > _DARK) & (encoded > _DARK / 2)  # far below: a cast shadow
    lit = lit & (predicted < SATURATED - _DARK / 2) & (encoded < SATURATED)
    used = enough(known & lit, problem.rank)
    if int(used.any(dim=0).sum()) <= 4 * problem.rank:
        used = problem.used
    residual = (encoded - predicted)[used]
    scale = CAUCHY_TUNING * float(robust_deviation(residual, residual.isfinite()))
    return problem.replace(used=used, scale=max(scale, _MIN_SCALE))


def _grid_search(problem: EncodedMatrix, iterations: int) -> tuple[float, EncodedFit]:
    trials = torch.logspace(
        math.log10(MIN_GAMMA), math.log10(MAX_GAMMA), _TRIALS, dtype=torch.float64
    )
    fits: list[EncodedFit] = []
    for exponent in trials.tolist():
        former = fits[-1] if fits else None
        fits.append(fit_encoded(problem, Gamma(exponent=exponent), former, iterations))
    losses = [float(fit.loss.sum()) for fit in fits]
    best = losses.index(min(losses))
    return float(trials[best]), fits[best]


def _minimise(problem: EncodedMatrix, start: EncodedFit, low: float, high: float) -> _Minimum:
    r"""Find the minimum, with gamma's sandwich standard error.

    With :math:`s_k` the derivative of the loss of sample (or view) k along the profile and h the
    second derivative of the whole, the variance is :math:`\sum_k s_k^2 / h^2`, over samples, or
    over views if that is larger; it needs no model of the noise. Infinite where the loss has next
    to no curvature.
    """
    fit = start

    def loss(logarithm: float) -> float:
        nonlocal fit
        fit = fit_encoded(problem, Gamma(exponent=math.exp(logarithm)), fit)
        return float(fit.loss.sum())

    bounds = (math.log(max(low, MIN_GAMMA)), math.log(min(high, MAX_GAMMA)))
    found = minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 1e-4})
    gamma = math.exp(found.x)
    fit = fit_encoded(problem, Gamma(exponent=gamma), fit)
    step = 0.02 * gamma
    below = fit_encoded(problem, Gamma(exponent=gamma - step), fit)
    above = fit_encoded(problem, Gamma(exponent=gamma + step), fit)
    centre = float(fit.loss.sum())
    curvature = (float(below.loss.sum()) + float(above.loss.sum()) - 2 * centre) / step**2
    slope = (above.loss - below.loss) / (2 * step)
    noise = max(float(slope.sum(dim=axis).square().sum()) for axis in (0, 1)) ** 0.5
    # On data without noise everything but the curvature is rounding.
    curved = curvature * gamma**2 > (_MIN_SCALE * 0.1) ** 2 * int(problem.used.sum())
    error = noise / curvature if curved else math.inf
    return _Minimum(problem=problem, gamma=gamma, fit=fit, error=error)


def _consistent_minimum(problem: EncodedMatrix) -> _Minimum:
    """Estimate from all entries, or from the brighter ones where theirs differs significantly.

    Ambient light in attached shadows is not first-order: it biases the estimate from all entries.
    """
    best, fit = _grid_search(problem, 1)
    step = (MAX_GAMMA / MIN_GAMMA) ** (1 / (_TRIALS - 1))
    found = [_minimise(problem, fit, best / step, best * step)]
    predicted = found[0].fit.predicted
    for fraction in _DARKEST_FRACTIONS:
        level = predicted[problem.used].quantile(fraction)
        used = enough(problem.used & (predicted > level), problem.rank)
        if freedom(used, problem.rank) < 100:  # no reliable standard error
            break
        found.append(_minimise(problem.replace(used=used), found[0].fit, MIN_GAMMA, MAX_GAMMA))
    while any(
        abs(one.gamma - found[0].gamma) > _MAX_ERRORS * one.error + 1e-3 * found[0].gamma
        for one in found[1:]
        if one.inner
    ):
        found = found[1:]
    return found[0]
