r"""Integrability of pseudo-normals: the matrix that makes them normals of a surface.

Pseudo-normals :math:`s(x, y)` are shading vectors up to an unknown matrix, :math:`\rho n = A s`.
That they belong to a depth :math:`z(x, y)` with slopes :math:`-n_x/n_z, -n_y/n_z` means
:math:`\partial_y (n_x / n_z) = \partial_x (n_y / n_z)`. With the rows :math:`a_1, a_2, a_3` of
``A`` this is linear in two bivectors,

.. math:: (a_2 \wedge a_3) \cdot (s \wedge \partial_x s)
          + (a_3 \wedge a_1) \cdot (s \wedge \partial_y s) = 0,

in whatever dimension ``s`` has. Albedo drops out, as :math:`s \wedge s = 0`.

Source: Yuille & Snow, Shape and albedo from multiple images using integrability, CVPR 1997, for
three dimensions.
"""

from dataclasses import dataclass
from itertools import combinations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d, pad

from pimper_torch.errors import InputError
from pimper_torch.photometry.robust import CAUCHY_TUNING, cauchy_weights, robust_deviation
from pimper_torch.records import Record

# Differences are taken over cells of 1/64 of the object's size, and equations averaged over blocks
# of 1/16: averages lose no signal, as the unknowns are constant, and reduce the noise of the
# coefficients, which biases the solution. On the grey sphere of 215 pixels, normals after the best
# bas-relief are 7.3 degrees off with single pixels in blocks of 4, and 6.1 so.
_CELLS, _BLOCKS = 64, 16
_ITERATIONS = 10
# Minimum curl of the second best solution, as a fraction of the terms: a choice, above rounding.
_MIN_SECOND_CURL = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Curls(Record):
    """The coefficients of integrability, one equation per block of cells.

    Attributes:
        across: ``s ^ ds/dx``, pairs (0, 1), (0, 2), ... of components.
        noise: Covariance of ``across``, and of ``down``, from the noise of the pseudo-normals;
            up to a factor.
    """

    across: Float[Tensor, "equation pair"]
    down: Float[Tensor, "equation pair"]
    weight: Float[Tensor, " equation"]
    noise: Float[Tensor, "pair pair"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Integrable(Record):
    """The matrix that makes pseudo-normals of three dimensions integrable.

    Attributes:
        matrix: ``A``, up to a bas-relief transformation and a factor: shading is ``A s``.
        curl: Root mean square of the equations' residuals over that of their terms: 0 for a
            surface, 1 for unrelated terms.
        certainty: Residual of the second best solution over that of the best; near 1 the solution
            is arbitrary.
    """

    matrix: Float[Tensor, "3 3"]
    curl: float
    certainty: float


def wedge(
    one: Float[Tensor, "*batch size"], other: Float[Tensor, "*batch size"]
) -> Float[Tensor, "*batch pair"]:
    """Return the bivector of two vectors: ``u_i v_j - u_j v_i`` for i < j."""
    first, second = _pairs(one.shape[-1])
    return one[..., first] * other[..., second] - one[..., second] * other[..., first]


def curls(
    pseudo: Float[Tensor, "size pixel"],
    weight: Float[Tensor, " pixel"],
    mask: Bool[Tensor, "height width"],
    noise: Float[Tensor, "size size"] | None = None,
) -> Curls:
    """Assemble the equations of integrability over a raster.

    Pseudo-normals are whitened and normalized first, so that neither albedo nor its edges enter
    the differences. These are taken over the four corners of a square; a square with a pixel
    outside the mask, or without weight, has no equation.

    Args:
        pseudo: ``s`` of the pixels inside the mask, in raster order.
        noise: Covariance of ``s``, up to a factor; by default white.
    """
    s, w = pseudo.double(), weight.double()
    moment = (w * s) @ s.mT
    # The normals of a plane span one dimension only.
    ridge = 1e-12 * moment.diagonal().mean() + torch.finfo(s.dtype).tiny
    root = torch.linalg.cholesky(moment + ridge * torch.eye(len(s)).to(s))
    length = torch.linalg.solve_triangular(root, s, upper=False).norm(dim=0)
    known = (w > 0) & (length > 0)
    inverse = torch.where(known, 1 / torch.where(known, length, 1), 0)
    unit = s * inverse
    # Noise of the direction is proportional to 1 / length; the weight is bounded at the median.
    centre = length[known].median() if known.any() else length.new_ones(())
    reliability = torch.where(known, w * (length / centre).clamp_max(1) ** 2, 0)
    raster, heavy = s.new_zeros(*mask.shape, len(s)), s.new_zeros(mask.shape)
    raster[mask], heavy[mask] = unit.mT, reliability
    size = float(mask.sum()) ** 0.5
    step, block = max(1, round(size / _CELLS)), max(2, round(size / _BLOCKS))
    a, b = raster[:-step, :-step], raster[:-step, step:]
    c, d = raster[step:, :-step], raster[step:, step:]
    across = (wedge(a, b) + wedge(c, d)) / 2
    down = (wedge(a, c) + wedge(b, d)) / 2
    least = -max_pool2d(-heavy[None], step + 1, stride=1)[0]  # over all pixels of a square
    ones = torch.ones_like(down[..., :1])
    blocks = _pooled(torch.cat([across, down, ones], dim=-1), least, block)
    total = blocks[:, -1]
    some = total > 0
    pairs = across.shape[-1]
    if int(some.sum()) < 2 * pairs:
        raise InputError(
            f"integrability: {int(some.sum())} squares of {block} x {block} pixels have normals; "
            f"needed: {2 * pairs} or more. Widen the mask."
        )
    mean = blocks[some, :-1] / total[some, None]
    spread_of = torch.eye(len(s)).to(s) if noise is None else noise.double()
    axes = torch.linalg.cholesky(spread_of)
    parts = [wedge(unit.mT, (inverse * axis[:, None]).mT) for axis in axes.unbind(dim=1)]
    return Curls(
        across=mean[:, :pairs],
        down=mean[:, pairs:],
        weight=total[some],
        noise=torch.stack([(reliability[:, None] * part).mT @ part for part in parts]).sum(dim=0),
    )


def integrable(
    pseudo: Float[Tensor, "3 pixel"],
    weight: Float[Tensor, " pixel"],
    mask: Bool[Tensor, "height width"],
    noise: Float[Tensor, "3 3"] | None = None,
) -> Integrable:
    """Find the matrix that makes pseudo-normals the normals of a surface.

    The six unknowns are the least generalised eigenvector of the equations' squares against
    those of noise alone (total least squares); equations get Cauchy's weights, as they do not hold
    across depth edges. The remaining bas-relief transformation is set by orthogonal rows. The third
    component of most normals is negative. Constant to autograd.

    Raises:
        InputError: Fewer than six equations, or a surface (a plane, a cylinder) that
            satisfies them with more than one matrix.

    Source: Yuille & Snow, CVPR 1997; the noise model, the averaging and the weights are ours.
    """
    with torch.no_grad():
        found, curl, certainty = _least(curls(pseudo, weight, mask, noise))
        p, q = _vector(found[:3]), _vector(found[3:])
        third = torch.linalg.cross(p, q)
        size = third.norm().sqrt()
        p, q, third = p / size, q / size, third / size**2
        matrix = torch.stack([torch.linalg.cross(q, third), torch.linalg.cross(third, p), third])
        facing = (weight * (third.to(pseudo) @ pseudo).sign()).sum()
        matrix[2] *= -1 if facing > 0 else 1
        return Integrable(matrix=matrix.to(pseudo), curl=curl, certainty=certainty)


def moments(equations: Curls) -> tuple[Float[Tensor, "both both"], Float[Tensor, "both both"]]:
    """Return the quadratic forms of the equations' residuals, and of their terms."""
    both = torch.cat([equations.across, equations.down], dim=1)
    full = (equations.weight[:, None] * both).mT @ both
    terms = full.clone()
    pairs = equations.across.shape[1]
    terms[:pairs, pairs:] = 0
    terms[pairs:, :pairs] = 0
    return full, terms


def both_ways(noise: Float[Tensor, "pair pair"]) -> Float[Tensor, "both both"]:
    """Return the joint covariance of ``across`` and ``down``, which are uncorrelated."""
    return torch.kron(torch.eye(2).to(noise), noise)


def reweighted(equations: Curls, solution: Float[Tensor, " both"]) -> Float[Tensor, " equation"]:
    """Update the equations' weights by their residuals under a solution."""
    both = torch.cat([equations.across, equations.down], dim=1)
    residual = both @ solution
    scale = CAUCHY_TUNING * robust_deviation(residual, equations.weight > 0)
    return equations.weight * cauchy_weights(residual, scale)


def _least(equations: Curls) -> tuple[Float[Tensor, " both"], float, float]:
    """Solve by reweighted total least squares; give the curl and the certainty, too."""
    metric = both_ways(equations.noise)
    eye = torch.eye(len(metric)).to(metric)
    root = torch.linalg.cholesky(metric + 1e-12 * metric.diagonal().mean() * eye)
    reweighted_equations = equations
    for _ in range(_ITERATIONS):
        full, terms = moments(reweighted_equations)
        inner = torch.linalg.solve_triangular(root, full, upper=False)
        inner = torch.linalg.solve_triangular(root, inner.mT, upper=False)
        values, vectors = torch.linalg.eigh((inner + inner.mT) / 2)
        vectors = torch.linalg.solve_triangular(root.mT, vectors, upper=True)
        reweighted_equations = equations.replace(weight=reweighted(equations, vectors[:, 0]))
    fraction = [_curl(full, terms, vectors[:, one]) for one in (0, 1)]
    if not fraction[1] > _MIN_SECOND_CURL:
        raise InputError(
            "integrability: more than one matrix makes these pseudo-normals a surface, as for a "
            "plane or a cylinder; needed: curvature in two directions. Widen the mask."
        )
    least = float(values[0].clamp_min(torch.finfo(values.dtype).tiny))
    return vectors[:, 0], fraction[0], (float(values[1]) / least) ** 0.5


def _curl(
    full: Float[Tensor, "both both"],
    terms: Float[Tensor, "both both"],
    solution: Float[Tensor, " both"],
) -> float:
    total = float(solution @ terms @ solution)
    return (max(0.0, float(solution @ full @ solution)) / total) ** 0.5 if total > 0 else 0.0


def _pairs(size: int) -> tuple[list[int], list[int]]:
    pairs = list(combinations(range(size), 2))
    return [first for first, _ in pairs], [second for _, second in pairs]


def _vector(bivector: Float[Tensor, " 3"]) -> Float[Tensor, " 3"]:
    """Return the vector dual to a bivector of space."""
    xy, xz, yz = bivector
    return torch.stack([yz, -xz, xy])


def _pooled(
    values: Float[Tensor, "height width channel"], weight: Float[Tensor, "height width"], block: int
) -> Float[Tensor, "square channel"]:
    """Sum values by weight over squares."""
    height, width = weight.shape
    heavy = (values * weight[..., None]).movedim(-1, 0)
    padded = pad(heavy, (0, -width % block, 0, -height % block))
    return avg_pool2d(padded[None], block)[0].flatten(1).mT * block**2
