r"""The ambiguity of rank-three factorization under integrability: bas-relief transformations.

:math:`J = L B = (L A^{-1})(A B)` for every invertible 3 x 3 matrix, where the columns of ``B``
are albedo times normal. Integrability, that normals belong to a surface ``z(x, y)``, restricts
``A`` to the generalised bas-relief transformations :math:`\bar z = \lambda z + \mu x + \nu y`,
times one factor between albedo and light.

Source: Belhumeur, Kriegman & Yuille, IJCV 35(1), 1999.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.records import Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class BasRelief(Record):
    r"""A generalised bas-relief transformation, ready to act on a factorization.

    Frame: x right, y down, z forward, normals facing the viewer (``n_z < 0``); the surface's
    depth becomes :math:`\lambda z + \mu x + \nu y`, and :math:`b = \rho n` becomes ``G b``
    with ``G = [[lambda, 0, -mu], [0, lambda, -nu], [0, 0, 1]]``.

    Attributes:
        mu: Tilt along x.
        nu: Tilt along y.
        lam: Flattening, not zero; below zero hills become valleys.

    >>> tilt = BasRelief(mu=torch.tensor(0.5), nu=torch.tensor(0.0), lam=torch.tensor(2.0))
    >>> tilt.on_shading(torch.tensor([[0.0], [0.0], [-1.0]]))[:, 0]
    tensor([ 0.5000,  0.0000, -1.0000])
    """

    mu: Float[Tensor, "*batch"]
    nu: Float[Tensor, "*batch"]
    lam: Float[Tensor, "*batch"]

    @property
    def matrix(self) -> Float[Tensor, "*batch 3 3"]:
        """``G``."""
        zero, one = torch.zeros_like(self.lam), torch.ones_like(self.lam)
        rows = [[self.lam, zero, -self.mu], [zero, self.lam, -self.nu], [zero, zero, one]]
        return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)

    def on_shading(self, shading: Float[Tensor, "*batch 3 sample"]) -> Float[Tensor, "..."]:
        """Return ``G B``."""
        return self.matrix @ shading

    def on_lights(self, lights: Float[Tensor, "*batch view 3"]) -> Float[Tensor, "..."]:
        """Return ``L G^-1``, so that the product with :meth:`on_shading` stays the data."""
        return lights @ self.inverse().matrix

    def inverse(self) -> "BasRelief":
        """Return the transformation that undoes this one."""
        return BasRelief(mu=-self.mu / self.lam, nu=-self.nu / self.lam, lam=1 / self.lam)

    def after(self, first: "BasRelief") -> "BasRelief":
        """Return this transformation after another: they form a group."""
        return BasRelief(
            mu=self.lam * first.mu + self.mu,
            nu=self.lam * first.nu + self.nu,
            lam=self.lam * first.lam,
        )
