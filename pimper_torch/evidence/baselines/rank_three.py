r"""Rank-three photometric stereo: masked factorization, its ambiguity reduced by integrability.

A distant point light a view and no ambient light make :math:`J = L B` with L F x 3 and the columns
of B albedo times normal. The factors are found up to an invertible 3 x 3 matrix
:math:`B = A \hat B`; that the normals are those of a surface leaves of it a generalised
bas-relief transformation, which known depths fix.

Source: Yuille, Snow, Epstein & Belhumeur, Determining generative models of objects under
varying illumination: shape and albedo from multiple images using SVD and integrability,
IJCV 35(3), 1999.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.evidence.baselines.one_matrix import chunks
from pimper_torch.photometry.quadratics import diagonal, outer, solve_packed
from pimper_torch.photometry.robust import CAUCHY_TUNING, cauchy_weights, robust_deviation
from pimper_torch.records import Record

# Filling in the missing entries comes near; the alternation after it is exact.
FILL_STEPS = 20

# Slopes above this (84 degrees) are limited to it while the ambiguity is sought.
STEEPEST = 10.0


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Rank3(Record):
    """The factors.

    Attributes:
        lights: ``L``.
        vectors: ``B``, albedo times normal; zero where fewer than three views see a sample.
    """

    lights: Float[Tensor, "view 3"]
    vectors: Float[Tensor, "3 sample"]

    def moved(self, matrix: Float[Tensor, "3 3"]) -> "Rank3":
        """Return ``L A^-1`` and ``A B``, whose product is the same."""
        move = matrix.double()
        return Rank3(
            lights=(self.lights.double() @ torch.linalg.inv(move)).to(self.lights),
            vectors=(move @ self.vectors.double()).to(self.vectors),
        )


def factorize_rank_three(
    radiance: Float[Tensor, "view sample"],
    seen: Bool[Tensor, "view sample"],
    alternations: int,
    tolerance: float = 1e-5,
) -> Float[Tensor, "view 3"]:
    """Return the lights of the masked rank-three factorization.

    Missing entries are filled with a sample's brightness times a view's, then with the
    rank-three part of the filled matrix in turn; weighted alternation follows until the
    lights' span turns by less than ``tolerance`` in a step. Lights come out with orthonormal
    columns: their scale and rotation are part of the ambiguity.
    """
    J, weight = radiance.double(), seen.double()
    gain = (weight * J).sum(dim=1, keepdim=True) / weight.sum(dim=1, keepdim=True).clamp_min(1)
    albedo = (weight * J).sum(dim=0) / (weight * gain).sum(dim=0).clamp_min(1e-12)
    filled = torch.where(seen, J, gain * albedo)
    basis = _leading(filled)
    for _ in range(FILL_STEPS):
        filled = torch.where(seen, J, basis @ (basis.mT @ filled))
        basis = _leading(filled)
    for _ in range(alternations):
        vectors = solve_vectors(J, seen, basis)
        packed = (weight @ outer(vectors).mT).mT
        ridge = 1e-9 * packed[diagonal(3)].sum(dim=0).amax()
        packed[diagonal(3)] += ridge
        lights = solve_packed(packed, ((weight * J) @ vectors.mT).mT).mT
        rotated = torch.linalg.qr(lights).Q
        change = (rotated - basis @ (basis.mT @ rotated)).norm()
        basis = rotated
        if change < tolerance:
            break
    return basis.to(radiance)


def solve_vectors(
    radiance: Float[Tensor, "view sample"],
    seen: Bool[Tensor, "view sample"],
    lights: Float[Tensor, "view 3"],
) -> Float[Tensor, "3 sample"]:
    """Give every sample's vector by least squares, lights given, of minimum norm if not unique."""
    parts = []
    basis = outer(lights.mT)
    for part in chunks(radiance.shape[1]):
        weight = seen[:, part].to(radiance)
        packed = basis @ weight
        packed[diagonal(3)] += 1e-9 * packed[diagonal(3)].sum(dim=0).amax()
        parts.append(solve_packed(packed, lights.mT @ (weight * radiance[:, part])))
    return torch.cat(parts, dim=1)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Spans(Record):
    """Factors sampled between pairs of points on the surface, template frame.

    Attributes:
        step: From one point to the other: x, y and z.
        vectors: Of the factorization, at positions evenly spread between them.
        valid: Which of these mean something.
    """

    step: Float[Tensor, "span 3"]
    vectors: Float[Tensor, "span sample 3"]
    valid: Bool[Tensor, "span sample"]


def ambiguity_between_points(
    spans: Spans, start: Float[Tensor, "3 3"], iterations: int = 50
) -> Float[Tensor, "3 3"]:
    r"""Find the 3 x 3 matrix under which integrated slopes match the points' depths.

    Minimises, over spans and in float64, Cauchy's loss of

    .. math::

        \Delta_z - \Delta_{xy} \cdot \overline{(p, q)}, \qquad
        p = -\frac{a_1 \cdot b}{a_3 \cdot b}, \quad q = -\frac{a_2 \cdot b}{a_3 \cdot b},

    the mean being taken along the span and :math:`a_i` the rows of A. This is integrability in
    integral form: sums round every triangle of points vanish because the points' do, and the
    bas-relief transformation is fixed with the rest. Steps are Levenberg's and
    Marquardt's.

    Args:
        spans: Between the points.
        start: A matrix not too far from A; see :func:`matrix_between_lights`.
        iterations: Steps.

    Returns:
        A, of norm 1 and with most vectors facing the viewer; its size, which is that of
        albedo, stays free.
    """
    b, valid = spans.vectors.double(), spans.valid.double()
    b = b / b.norm(dim=-1, keepdim=True).clamp_min(1e-30)
    step = spans.step.double()
    fraction = valid / valid.sum(dim=1, keepdim=True).clamp_min(1)
    known = valid.sum(dim=1) >= valid.shape[1] / 2
    matrix = start.double()
    towards = (valid * (b @ matrix[2])).sum()
    matrix = matrix / matrix.norm() * (-1 if towards > 0 else 1)
    return _descended(matrix, b, fraction, step, known, iterations).to(spans.vectors)


def matrix_between_lights(
    lights: Float[Tensor, "view 3"], known: Float[Tensor, "view 3"]
) -> Float[Tensor, "3 3"]:
    """Return the matrix that aligns a factorization with known lights.

    Lights, not normals: those of a coarse surface are smoother than the true ones, and what
    turns the vectors along them may have no rank. Each light counts with its own size.
    """
    inverse = torch.linalg.lstsq(lights.double(), known.double(), driver="gelsd").solution
    return torch.linalg.pinv(inverse).to(lights)


def _descended(
    matrix: Float[Tensor, "3 3"],
    b: Float[Tensor, "span sample 3"],
    fraction: Float[Tensor, "span sample"],
    step: Float[Tensor, "span 3"],
    known: Bool[Tensor, " span"],
    iterations: int,
) -> Float[Tensor, "3 3"]:
    """Minimize by Levenberg-Marquardt."""
    damping = 1e-3
    for round_ in range(iterations):
        residual, slope = _residual(matrix, b, fraction, step, known)
        if round_ % 5 == 0:
            scale = CAUCHY_TUNING * robust_deviation(residual, known)
        weight = known * cauchy_weights(residual, scale)
        normal = (weight[:, None] * slope).mT @ slope
        ridge = damping * normal.diagonal().clamp_min(1e-12 * normal.diagonal().max() + 1e-30)
        descent = torch.linalg.solve(normal + torch.diag(ridge), slope.mT @ (weight * residual))
        moved = matrix - descent.reshape(3, 3)
        moved = moved / moved.norm()
        after, _ = _residual(moved, b, fraction, step, known)
        if (weight * after**2).sum() < (weight * residual**2).sum():
            matrix, damping = moved, max(damping / 5, 1e-9)
        else:
            damping = min(10 * damping, 1e6)
    return matrix


def _residual(
    matrix: Float[Tensor, "3 3"],
    b: Float[Tensor, "span sample 3"],
    fraction: Float[Tensor, "span sample"],
    step: Float[Tensor, "span 3"],
    known: Bool[Tensor, " span"],
) -> tuple[Float[Tensor, " span"], Float[Tensor, "span 9"]]:
    """Return the residuals of the points' depths, and their derivative by A."""
    rotated = b @ matrix.mT
    # A sample without a vector has no slope; its share is 0, but it must stay finite.
    steepest = -(rotated.norm(dim=-1) / STEEPEST).clamp_min(1e-12)
    limited = rotated[..., 2] > steepest
    z = torch.where(limited, steepest, rotated[..., 2])
    run = (step[:, None, :2] * rotated[..., :2]).sum(dim=-1)
    rise = -run / z
    residual = known * ((fraction * rise).sum(dim=1) - step[:, 2])
    per_run = -(fraction / z)[..., None] * b
    by_third = torch.where(limited[..., None], 0, (fraction * run / z**2)[..., None] * b).sum(dim=1)
    by_rows = step[:, :2, None] * per_run.sum(dim=1)[:, None]
    slope = torch.cat([by_rows.flatten(1), by_third], dim=1)
    return residual, known[:, None] * slope


def _leading(filled: Float[Tensor, "view sample"]) -> Float[Tensor, "view 3"]:
    return torch.linalg.eigh(filled @ filled.mT).eigenvectors[:, -3:]
