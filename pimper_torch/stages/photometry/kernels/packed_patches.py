"""Packed patches: only the views and samples of a patch that have data, in contiguous arrays.

The solver packs in float32, Newton's method and the adjoint in float64.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels import signatures
from pimper_torch.kernels.compile import compiled
from pimper_torch.kernels.twin_constants import MIN_DEVIATION

Numbers = NDArray[Any]
Integers = NDArray[np.int64]


class ConeProblem(NamedTuple):
    """A batch of problems: see ``stages.photometry.bilinear``; ``given`` are the weights."""

    radiance: signatures.Floats3
    given: signatures.Floats3
    prior_mean: signatures.Floats3
    regularization: signatures.Floats2
    prior: signatures.Floats3


class ConeSolution(NamedTuple):
    """The solution of a batch.

    Attributes:
        shading: Samples without weight keep their initial value.
        weight: Final weights; zero before.
        residual: Root mean square.
        iterations: Number of steps.
        cause: Code of the stop cause.
    """

    lights: signatures.Floats3
    shading: signatures.Floats3
    weight: signatures.Floats3
    residual: signatures.Floats1
    iterations: signatures.Integers1
    cause: signatures.Integers1


class FactorData(NamedTuple):
    """A batch of problems in float64, or derivatives by its data."""

    radiance: signatures.Doubles3
    given: signatures.Doubles3
    prior_mean: signatures.Doubles3
    regularization: signatures.Doubles2
    prior: signatures.Doubles3


class FactorSolution(NamedTuple):
    """The solution of a batch in float64, or derivatives by it."""

    lights: signatures.Doubles3
    shading: signatures.Doubles3
    weight: signatures.Doubles3
    residual: signatures.Doubles1


class Selection(NamedTuple):
    """Views and samples of patch ``p`` with data; ``num_scale`` samples are for the deviation."""

    p: int
    views: Integers
    samples: Integers
    num_scale: int


class Patch(NamedTuple):
    """A packed patch, its samples padded to whole tiles.

    Attributes:
        radiance: View by sample.
        given: Weight of each entry; 0 in the padding.
        weight: ``given`` times robust weights.
        residual: Workspace.
        prior: Packed entry by sample.
        equations: The samples' normal equations: ten packed entries and the right-hand side.
        prior_mean: View by 4.
        regularization: Of each view.
        slack: Sum of the regularization of the omitted views, times 4.
        num_views: Including omitted views.
        num_scale: Number of samples, the first ones, for the estimate of the residual deviation.
        min_deviation: Minimum deviation of residuals.
        loss: Code of the loss.
        scale: Of the loss, in deviations.
    """

    radiance: Numbers
    given: Numbers
    weight: Numbers
    residual: Numbers
    prior: Numbers
    equations: Numbers
    prior_mean: Numbers
    regularization: Numbers
    slack: float
    num_views: int
    num_scale: int
    min_deviation: float
    loss: int
    scale: float


@compiled()
def copy_unseen(
    problem: ConeProblem | FactorData, p: int, source: Numbers, target: Numbers
) -> None:
    """Copy the rows of a patch's views whose light is its prior mean, because they have no data."""
    for f in range(target.shape[1]):
        if problem.regularization[p, f] > 0 and not np.any(problem.given[p, f] > 0):
            for i in range(4):
                target[p, f, i] = source[p, f, i]


@compiled()
def selected(problem: ConeProblem | FactorData, p: int, stride: int) -> Selection:
    """Return the views and the samples with data, every ``stride``-th sample first."""
    given = problem.given[p]
    views, seen = np.empty(len(given), np.int64), np.zeros(given.shape[1], np.bool_)
    num_views = 0
    for f in range(len(given)):
        row, has_data = given[f], False
        for k in range(len(row)):
            has_data |= row[k] > 0
            seen[k] |= row[k] > 0
        views[num_views] = f
        num_views += has_data
    samples = np.empty(len(seen), np.int64)
    count = 0
    for k in range(0, len(seen), stride):
        if seen[k]:
            samples[count] = k
            count += 1
    num_scale = count
    for k in range(len(seen)):
        if seen[k] and k % stride > 0:
            samples[count] = k
            count += 1
    return Selection(p, views[:num_views], samples[:count], num_scale)


@compiled()
def gathered(
    lights: Numbers, shading: Numbers, selection: Selection, padded: int
) -> tuple[Numbers, Numbers]:
    """Return a patch's rows of lights, and columns of shading, zero in the padding."""
    p, views, samples, _ = selection
    shade = np.zeros((shading.shape[1], padded), shading.dtype)
    for i in range(len(shade)):
        for k in range(len(samples)):
            shade[i, k] = shading[p, i, samples[k]]
    return lights[p][views], shade


@compiled()
def packed(
    problem: ConeProblem | FactorData, selection: Selection, tile: int, loss: int, scale: float
) -> Patch:
    """Return a packed patch; ``tile`` divides its number of samples."""
    p, views, samples, num_scale = selection
    radiance, given, regularization = (
        problem.radiance[p],
        problem.given[p],
        problem.regularization[p],
    )
    num_views, num_samples, kind = len(views), len(samples), radiance.dtype
    shape = num_views, tile * (-(-num_samples // tile))
    radiance_rows, weight = np.zeros(shape, kind), np.zeros(shape, kind)
    size, count, slack = 0.0, 0.0, 0.0
    for f in range(len(regularization)):
        slack += 4 * regularization[f]
    for f in range(num_views):
        source, weights_row = radiance[views[f]], given[views[f]]
        for k in range(num_samples):
            radiance_rows[f, k], weight[f, k] = source[samples[k]], weights_row[samples[k]]
            size += abs(radiance_rows[f, k])
            count += weight[f, k]
        slack -= 4 * regularization[views[f]]
    prior_mean, prior = gathered(problem.prior_mean, problem.prior, selection, shape[1])
    # The identity makes the equations of the padding regular.
    for i in (0, 4, 7, 9):
        prior[i, num_samples:] = 1
    return Patch(
        radiance=radiance_rows,
        given=weight,
        weight=weight.copy(),
        residual=np.empty(shape, kind),
        prior=prior,
        equations=np.empty((14, shape[1]), kind),
        prior_mean=prior_mean,
        regularization=regularization[views],
        slack=max(slack, 0.0),
        num_views=len(regularization),
        num_scale=num_scale,
        min_deviation=MIN_DEVIATION * size / max(count, 1.0),
        loss=loss,
        scale=scale,
    )


@compiled()
def scattered(
    solution: ConeSolution | FactorSolution,
    selection: Selection,
    weight: Numbers,
    light: Numbers,
    shade: Numbers,
) -> None:
    """Write a patch's weights, lights and shading to the solution."""
    p, views, samples, _ = selection
    for f in range(len(views)):
        for k in range(len(samples)):
            solution.weight[p, views[f], samples[k]] = weight[f, k]
    for i in range(4):
        for f in range(len(views)):
            solution.lights[p, views[f], i] = light[f, i]
        for k in range(len(samples)):
            solution.shading[p, i, samples[k]] = shade[i, k]
