r"""The matrix ``M = G^T G`` by which a factorization measures albedo.

For a bas-relief transformation ``G`` and shading ``b``, albedo is :math:`\lVert G b \rVert`, so
its square :math:`b^\top M b` is linear in the four entries that ``M`` has:

.. math:: M = s^2 \begin{pmatrix} \lambda^2 & 0 & -\lambda\mu \\ 0 & \lambda^2 & -\lambda\nu \\
          -\lambda\mu & -\lambda\nu & 1 + \mu^2 + \nu^2 \end{pmatrix}
          = \begin{pmatrix} m_0 & 0 & m_1 \\ 0 & m_0 & m_2 \\ m_1 & m_2 & m_3 \end{pmatrix}.

``M`` is the same for ``G`` and for ``G`` with hills turned into valleys (all of lambda, mu and
nu negated): albedos and angles do not distinguish the two.

Source: Belhumeur, Kriegman & Yuille, IJCV 35(1), 1999, for ``G``; the rest follows.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.single_view.factorization.bas_relief import BasRelief

# Relative rounding of squares of parallel vectors in float32.
_FLAT = 1e-12


def relief_of_metric(metric: Float[Tensor, "*batch 4"]) -> BasRelief:
    """Return the transformation, with lambda above zero, that a metric belongs to.

    Entries may have any common factor; where they are no metric, the result is NaN.
    """
    metric = metric * metric[..., :1].sign()
    m0, m1, m2, m3 = metric.unbind(dim=-1)
    square = m3 - (m1 * m1 + m2 * m2) / m0
    scale = torch.where((m0 > 0) & (square > 0), square, torch.nan).sqrt()
    root = m0.sqrt()
    lam = root / scale
    return BasRelief(mu=-m1 / (root * scale), nu=-m2 / (root * scale), lam=lam)


def standard_relief(shading: Float[Tensor, "3 pixel"]) -> BasRelief:
    r"""Find the transformation to a canonical form, the same for all bas-reliefs of a surface.

    After it :math:`\sum x z = \sum y z = 0` and :math:`\sum x^2 + y^2 = \sum z^2`: the surface
    faces the viewer on average, at a mean tilt of 45 degrees. Methods that start here do not
    depend on the transformation they were given. Lambda is above zero.

    NaN where all normals are parallel. Differentiable.
    """
    x, y, z = shading.double()
    depth = (z * z).sum()
    tilt_x, tilt_y = (x * z).sum() / depth, (y * z).sum() / depth
    slant = (x - tilt_x * z).square().sum() + (y - tilt_y * z).square().sum()
    curved = slant > _FLAT * (depth + (x * x + y * y).sum())
    lam = (depth / torch.where(curved, slant, torch.nan)).sqrt()
    return BasRelief(mu=lam * tilt_x, nu=lam * tilt_y, lam=lam)
