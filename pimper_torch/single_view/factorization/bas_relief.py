r"""Generalized bas-relief transformations, and their resolution by convention or equal lights.

:math:`J = L B = (L A^{-1})(A B)` for every invertible 3 x 3 matrix, where the columns of ``B``
are albedo times normal. Integrability (the normals are those of a surface ``z(x, y)``) restricts
``A`` to the generalized bas-relief transformations :math:`\bar z = \lambda z + \mu x + \nu y`,
times one factor between albedo and light.

Point lights of equal strength determine the quadratic form of lengths, of which bas-relief leaves
four entries unknown. The transformation is then unique up to convex or concave.

Source: Belhumeur, Kriegman & Yuille, IJCV 35(1), 1999; Hayakawa, Photometric stereo under a light
source with arbitrary motion, JOSA A 11(11), 1994, for the form.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import least_squares
from torch import Tensor

from pimper_torch.records import Record
from pimper_torch.records.shapes import Mask, Scalars
from pimper_torch.runtime.errors import InputError

Shading = Float[Tensor, "3 pixel"]
PerPixel = Float[Tensor, " pixel"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class BasRelief(Record):
    r"""A generalized bas-relief transformation of a factorization.

    Camera frame, ``n_z < 0``; depth becomes :math:`\lambda z + \mu x + \nu y`, and
    :math:`b = \rho n` becomes ``G b`` with ``G = [[lambda, 0, -mu], [0, lambda, -nu], [0, 0, 1]]``.

    Attributes:
        lam: Factor of depth, not zero; a negative factor turns hills into valleys.

    >>> tilt = BasRelief(mu=torch.tensor(0.5), nu=torch.tensor(0.0), lam=torch.tensor(2.0))
    >>> tilt.on_shading(torch.tensor([[0.0], [0.0], [-1.0]]))[:, 0]
    tensor([ 0.5000,  0.0000, -1.0000])
    """

    mu: Scalars
    nu: Scalars
    lam: Scalars

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
        """Return ``L G^-1``; its product with :meth:`on_shading` is the data."""
        return lights @ self.inverse().matrix

    def inverse(self) -> "BasRelief":
        """Return the inverse transformation."""
        return BasRelief(mu=-self.mu / self.lam, nu=-self.nu / self.lam, lam=1 / self.lam)

    def after(self, first: "BasRelief") -> "BasRelief":
        """Return the composition: ``first``, then this transformation. They form a group."""
        return BasRelief(
            mu=self.lam * first.mu + self.mu,
            nu=self.lam * first.nu + self.nu,
            lam=self.lam * first.lam,
        )


def standard_relief(shading: Shading, weight: PerPixel | None = None) -> BasRelief:
    r"""Return the transformation to a canonical form, common to all bas-reliefs of a surface.

    The transformed surface is upright on average and as deep as a ball:
    :math:`\sum w x z = \sum w y z = 0` and :math:`\sum w (x^2 + y^2) = \sum w z^2`. Lambda is
    positive, and NaN if all normals are parallel. Differentiable.
    """
    x, y, z = shading.double()
    w = torch.ones_like(z) if weight is None else weight.double()
    depth = (w * z * z).sum()
    tilt_x, tilt_y = (w * x * z).sum() / depth, (w * y * z).sum() / depth
    slant = (w * ((x - tilt_x * z).square() + (y - tilt_y * z).square())).sum()
    # Relative rounding error of squares of parallel vectors in float32.
    curved = slant > 1e-12 * (depth + (w * (x * x + y * y)).sum())
    lam = (depth / torch.where(curved, slant, torch.nan)).sqrt()
    return BasRelief(mu=lam * tilt_x, nu=lam * tilt_y, lam=lam)


def convex(relief: BasRelief, shading: Shading, weight: PerPixel, mask: Mask) -> BasRelief:
    """Return the transformation or its mirror image, which fits equally well: the convex one.

    Args:
        shading: Untransformed, in raster order; transformed normals then point outwards on average.
    """
    upright = relief.to(shading.dtype)
    sideways, w = upright.on_shading(shading)[:2], weight.to(shading)
    rows, columns = torch.nonzero(mask, as_tuple=True)
    position = torch.stack([columns, rows]).to(shading)
    position = position - (w * position).sum(dim=1, keepdim=True) / w.sum().clamp_min(1e-30)
    sign = torch.where((w * position * sideways).sum() < 0, -1.0, 1.0).to(shading)
    return BasRelief(mu=sign * upright.mu, nu=sign * upright.nu, lam=sign * upright.lam)


def relief_from_strength(
    lights: Float[Tensor, "view 3"], shading: Shading, weight: PerPixel, mask: Mask
) -> BasRelief:
    """Return the convex bas-relief transformation under which most point lights are equally strong.

    Squared strengths are fitted to 1, with Cauchy's loss, from several depths. No gradient.

    Args:
        lights: Lights of the same factorization as the shading; zero rows are ignored.
        shading: Albedo times normal up to bas-relief, in raster order, to decide on convexity.
    """
    rows = lights[(lights != 0).any(dim=1)].detach().double()
    if len(rows) < 4:
        raise InputError(
            f"point lights of equal strength: {len(rows)} are given; needed: four or more."
        )
    size = rows.norm(dim=1).median()
    x, y, z = (rows / size).mT.numpy()

    def excess(parameters: np.ndarray) -> np.ndarray:
        across, tilt_x, tilt_y, along = parameters
        return across**2 * (x * x + y * y) + (tilt_x * x + tilt_y * y + along * z) ** 2 - 1

    # Strengths that differ by more than 2.5 % lose weight.
    fits = [
        least_squares(excess, (depth, 0.0, 0.0, 1.0), loss="cauchy", f_scale=0.05)
        for depth in (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
    ]
    across, tilt_x, tilt_y, along = shading.new_tensor(min(fits, key=lambda fit: fit.cost).x)
    relief = BasRelief(mu=tilt_x / across, nu=tilt_y / across, lam=along / across)
    return convex(relief, shading, weight, mask)
