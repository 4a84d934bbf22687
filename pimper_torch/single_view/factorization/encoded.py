r"""First-order light fitted to encoded values, through a camera's response.

Residuals are those of encoded values, where the noise is:
:math:`e = M - f^{-1}(L R)` with f the response.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.photometry.robust import cauchy_weights, robust_deviation
from pimper_torch.photometry.variable_projection import solve_variable_projection
from pimper_torch.radiometry import Response
from pimper_torch.records import Record
from pimper_torch.single_view.factorization.low_rank import low_rank_problem, singular_left

# Further linearizations about the fit, with outlier weights: a choice, as each exponent starts from
# the last one's fit.
ITERATIONS = 1
_ITERATIONS, _TOLERANCE = 30, 1e-7
_FILL_STEPS = 30  # to a start good enough for the solver

# Lower bound of the encoded value about which the fit is linearized: a choice.
_DARKEST = 0.02


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class EncodedMatrix(Record):
    """Encoded values of the same samples in several views.

    Attributes:
        seen: False where missing.
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
    problem: EncodedMatrix,
    response: Response,
    start: EncodedFit | None,
    iterations: int = ITERATIONS,
) -> EncodedFit:
    """Fit first-order light to encoded values through a response.

    The encoded residual is linearized, first about the values or a former fit, then about the
    fit: it is then least squares in radiance, weighted by the square of the response's slope.
    Constant to autograd.

    Args:
        response: Through which they are seen; ``f``.
        start: Fit of a similar response; ``None`` starts from the values.
    """
    mask = problem.used.double()
    about, weight = torch.where(problem.used, problem.encoded, 0.5), mask
    left: Tensor | None = None
    if start is not None:
        about, weight, left = start.predicted, mask * start.weight, start.left
    for iteration in range(iterations + 1):
        rate = _derivative(response, about)
        target = response.linear_from_encoded(about) + rate * (problem.encoded - about)
        heavy = weight / rate.square()
        heavy = heavy / heavy.max()
        if left is None:
            left = _start(target, mask, problem.rank)
        matrix = low_rank_problem(target[None], heavy[None], left[None])
        solved = solve_variable_projection(matrix, _ITERATIONS, _TOLERANCE)
        left = solved.lights[0]
        linear = left @ solved.shading[0]
        about = response.encoded_from_linear(linear).clamp_min(_DARKEST)
        residual = mask * (problem.encoded - about)
        if problem.scale and iteration < iterations:
            weight = mask * cauchy_weights(residual, torch.tensor(problem.scale).to(residual))
    loss = residual.square()
    if problem.scale:
        loss = problem.scale**2 * torch.log1p(loss / problem.scale**2)
    assert left is not None, "there is one round at least"
    return EncodedFit(predicted=about, loss=loss, weight=weight, left=left)


def _derivative(
    response: Response, encoded: Float[Tensor, "view sample"]
) -> Float[Tensor, "view sample"]:
    with torch.enable_grad():
        at = encoded.detach().requires_grad_()
        (rate,) = torch.autograd.grad(response.linear_from_encoded(at).sum(), at)
    return rate


def _start(
    matrix: Float[Tensor, "view sample"], mask: Float[Tensor, "view sample"], rank: int
) -> Float[Tensor, "view rank"]:
    """Impute missing values by albedo times brightness, then by low-rank approximations."""
    gain = (mask * matrix).sum(dim=1, keepdim=True) / mask.sum(dim=1, keepdim=True).clamp_min(1)
    level = (mask * gain).sum(dim=0, keepdim=True).clamp_min(1e-12)
    guess = gain * (mask * matrix).sum(dim=0, keepdim=True) / level
    return singular_left(matrix[None], mask[None], rank, guess[None], _FILL_STEPS - 1)[0]


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
    size = float(robust_deviation(residual, torch.ones_like(residual, dtype=torch.bool)))
    free = max(freedom(problem.used, problem.rank), 1)
    return size * (int(problem.used.sum()) / free) ** 0.5
