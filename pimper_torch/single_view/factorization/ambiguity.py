r"""The ambiguity of first-order factorization: scaled Lorentz transformations.

:math:`J = L N = (L A^{-1})(A N)` for every invertible 4 x 4 matrix, but ``A N`` stays on the
cone only if ``A`` preserves the form :math:`\eta = \mathrm{diag}(1, -1, -1, -1)` up to
scale: rotations (the frame), boosts (relatives of the bas-relief transformation),
reflections (convex against concave) and one factor between albedo and light.

Source: Basri, Jacobs & Kemelmacher, IJCV 72(3), 2007.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.records import Record
from pimper_torch.records.shapes import Scalars


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Ambiguity(Record):
    """A scaled Lorentz transformation of a factorization.

    Attributes:
        matrix: ``A`` with ``A^T eta A = s^2 eta``.

    >>> push = Ambiguity(matrix=lorentz(torch.tensor([0.0, 0.0, 0.3, 0.0, 0.0, 0.0])))
    >>> push.on_shading(push.inverse().on_shading(torch.ones(4, 1)))[:, 0].round(decimals=4)
    tensor([1., 1., 1., 1.])
    """

    matrix: Float[Tensor, "*batch 4 4"]

    def on_shading(self, shading: Float[Tensor, "*batch 4 sample"]) -> Float[Tensor, "..."]:
        """Return ``A N``."""
        return self.matrix @ shading

    def on_lights(self, lights: Float[Tensor, "*batch view 4"]) -> Float[Tensor, "..."]:
        """Return ``L A^-1``; its product with :meth:`on_shading` is the data."""
        return lights @ self.inverse().matrix

    def inverse(self) -> "Ambiguity":
        """Return the inverse transformation, ``eta A^T eta / s^2``."""
        eta = minkowski(self.matrix)
        return Ambiguity(matrix=eta @ self.matrix.mT @ eta / self.scale[..., None, None] ** 2)

    @property
    def scale(self) -> Scalars:
        """The factor ``s`` on albedo."""
        return torch.linalg.det(self.matrix).abs() ** 0.25


def minkowski(like: Float[Tensor, "..."]) -> Float[Tensor, "4 4"]:
    """Return ``diag(1, -1, -1, -1)``; ``s^T eta s = 0`` is the equation of the cone."""
    return torch.diag(like.new_tensor([1.0, -1.0, -1.0, -1.0]))


def lorentz(generator: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 4 4"]:
    """Return the matrix exponential of a generator, a proper Lorentz transformation.

    Args:
        generator: Three rapidities of the boost along x, y, z, then a rotation vector.

    Differentiable.
    """
    return torch.linalg.matrix_exp(_algebra(generator))


def align_factorizations(
    shading: Float[Tensor, "*batch 4 sample"],
    reference: Float[Tensor, "*batch 4 sample"],
    weight: Float[Tensor, "*batch sample"],
) -> Ambiguity:
    r"""Return the transformation that aligns one factorization best with another.

    Minimizes :math:`\sum_k w_k \lVert s e^{\omega} A_0 n_k - m_k \rVert^2` by Gauss-Newton
    over scale and generators. It starts from the unconstrained linear solution and its
    polar factor with respect to the form, including reflections.

    Args:
        shading: ``N`` to be aligned, columns on the cone.
        reference: Target of the alignment, columns on the cone.
        weight: Weights of samples, not negative. Samples of weight 0 are ignored.

    If the samples span less than four dimensions, the result is not unique, but still a scaled
    Lorentz transformation. Constant to autograd.
    """
    with torch.no_grad():
        source, target, w = shading.double(), reference.double(), weight.double()[..., None, :]
        moment = (w * source) @ source.mT
        ridge = 1e-9 * moment.diagonal(dim1=-2, dim2=-1).mean(dim=-1) + 1e-30
        eye = torch.eye(4, dtype=source.dtype, device=source.device)
        cross = (w * target) @ source.mT + ridge[..., None, None] * eye
        linear = torch.linalg.solve(moment + ridge[..., None, None] * eye, cross, left=False)
        matrix, eye = _nearest_lorentz(linear), torch.eye(7).to(linear)
        basis, root = torch.cat([_algebra(eye[:6, :6]), eye[None, :4, :4]]), w.sqrt()

        def misfit(tried: Tensor) -> Tensor:
            return (w * (target - tried @ source) ** 2).sum(dim=(-2, -1))

        for _ in range(10):
            moved = matrix @ source
            slopes = torch.einsum("gij,...jk->...gik", basis, moved)
            A = (slopes * root[..., None, :, :]).flatten(-2)
            r = ((target - moved) * root).flatten(-2)
            normal = A @ A.mT
            damping = 1e-9 * normal.diagonal(dim1=-2, dim2=-1).mean(dim=-1) + 1e-30
            normal = normal + damping[..., None, None] * eye
            step = torch.linalg.solve(normal, (A @ r[..., None])[..., 0])
            step = step * (1 / step.norm(dim=-1, keepdim=True).clamp_min(1e-30)).clamp_max(1)
            tried = step[..., 6, None, None].exp() * lorentz(step[..., :6]) @ matrix
            better = misfit(tried) < misfit(matrix)
            matrix = torch.where(better[..., None, None], tried, matrix)
        return Ambiguity(matrix=matrix.to(shading.dtype))


def _nearest_lorentz(linear: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Return the polar factor with respect to the form, by Newton's iteration.

    If it does not converge (far from every Lorentz transformation), the identity is returned.

    Source: Higham, Mackey, Mackey & Tisseur, SIAM J. Matrix Anal. 25(4), 2004.
    """
    eta = minkowski(linear)
    scale = Ambiguity(matrix=linear).scale[..., None, None]
    factor = linear / scale.clamp_min(1e-30)
    for _ in range(30):
        inverse = torch.linalg.inv_ex(factor).inverse
        factor = (factor + eta @ inverse.mT @ eta) / 2
    inexact = (factor.mT @ eta @ factor - eta).abs().amax(dim=(-2, -1)) > 1e-6
    failed = inexact | ~factor.isfinite().all(dim=-1).all(dim=-1) | (factor[..., 0, 0] < 0)
    eye = torch.eye(4, dtype=linear.dtype, device=linear.device)
    return torch.where(failed[..., None, None], eye, factor) * scale


def _algebra(generator: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 4 4"]:
    bx, by, bz, rx, ry, rz = generator.unbind(dim=-1)
    zero = torch.zeros_like(bx)
    rows = [[zero, bx, by, bz], [bx, zero, -rz, ry], [by, rz, zero, -rx], [bz, -ry, rx, zero]]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
