r"""Generalised bas-relief transformations, and conventions and albedos that determine one.

:math:`J = L B = (L A^{-1})(A B)` for every invertible 3 x 3 matrix, where the columns of ``B``
are albedo times normal. Integrability, that normals belong to a surface ``z(x, y)``, restricts
``A`` to the generalised bas-relief transformations :math:`\bar z = \lambda z + \mu x + \nu y`,
times one factor between albedo and light.

Vectors of one length (pixels of one albedo, point lights of one strength) determine the quadratic
form of lengths, of which bas-relief leaves four entries: the transformation follows up to convex or
concave.

Source: Belhumeur, Kriegman & Yuille, IJCV 35(1), 1999; Hayakawa, Photometric stereo under a light
source with arbitrary motion, JOSA A 11(11), 1994, for the form.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.photometry.robust import CAUCHY_TUNING, cauchy_weights, median_deviation
from pimper_torch.records import Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class BasRelief(Record):
    r"""A generalised bas-relief transformation, ready to act on a factorization.

    Camera frame, ``n_z < 0``; depth becomes :math:`\lambda z + \mu x + \nu y`, and
    :math:`b = \rho n` becomes ``G b`` with ``G = [[lambda, 0, -mu], [0, lambda, -nu], [0, 0, 1]]``.

    Attributes:
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


def standard_relief(shading: Float[Tensor, "3 pixel"]) -> BasRelief:
    r"""Find the transformation to a canonical form, the same for all bas-reliefs of a surface.

    After it :math:`\sum x z = \sum y z = 0` and :math:`\sum x^2 + y^2 = \sum z^2`. Lambda is above
    zero; NaN where all normals are parallel. Differentiable.
    """
    x, y, z = shading.double()
    depth = (z * z).sum()
    tilt_x, tilt_y = (x * z).sum() / depth, (y * z).sum() / depth
    slant = (x - tilt_x * z).square().sum() + (y - tilt_y * z).square().sum()
    # The relative rounding of squares of parallel vectors in float32.
    curved = slant > 1e-12 * (depth + (x * x + y * y).sum())
    lam = (depth / torch.where(curved, slant, torch.nan)).sqrt()
    return BasRelief(mu=lam * tilt_x, nu=lam * tilt_y, lam=lam)


def rounded_relief(
    shading: Float[Tensor, "3 pixel"],
    weight: Float[Tensor, " pixel"],
    mask: Bool[Tensor, "height width"],
) -> BasRelief:
    r"""Return the transformation that makes a surface upright on average, and as deep as a ball.

    :math:`\sum w b_x b_z = \sum w b_y b_z = 0` and
    :math:`\sum w (b_x^2 + b_y^2) = \sum w b_z^2`; of the two signs of ``lambda`` the convex one. A
    convention: the data do not determine it.

    Args:
        shading: Up to a bas-relief transformation, ``b_z < 0``, raster order.

    Differentiable; degenerate for a plane, where ``lambda`` is 1.
    """
    w = weight.to(shading)
    x, y, z = shading
    depth = (w * z * z).sum().clamp_min(torch.finfo(shading.dtype).tiny)
    mu, nu = (w * x * z).sum() / depth, (w * y * z).sum() / depth
    square = (w * ((x - mu * z) ** 2 + (y - nu * z) ** 2)).sum()
    flat = square <= torch.finfo(shading.dtype).tiny * depth
    lam = torch.where(flat, 1, (depth / torch.where(flat, 1, square)).sqrt())
    lam = lam * bulge(torch.stack([x - mu * z, y - nu * z]), w, mask)
    return BasRelief(mu=lam * mu, nu=lam * nu, lam=lam)


def convex(
    relief: BasRelief,
    shading: Float[Tensor, "3 pixel"],
    weight: Float[Tensor, " pixel"],
    mask: Bool[Tensor, "height width"],
) -> BasRelief:
    """Choose the convex one of a transformation and its mirror image, which fit equally well.

    Args:
        shading: It is applied to this, raster order.
    """
    found = relief.to(shading.dtype)
    sign = bulge(found.on_shading(shading)[:2], weight.to(shading), mask)
    return BasRelief(mu=sign * found.mu, nu=sign * found.nu, lam=sign * found.lam)


def bulge(
    sideways: Float[Tensor, "2 pixel"],
    weight: Float[Tensor, " pixel"],
    mask: Bool[Tensor, "height width"],
) -> Float[Tensor, ""]:
    """Return whether normals point outwards on average (1) or inwards (-1).

    Args:
        sideways: The parts of shading along x and y, uncorrelated with z.
    """
    rows, columns = torch.nonzero(mask, as_tuple=True)
    position = torch.stack([columns, rows]).to(sideways)
    total = weight.sum().clamp_min(torch.finfo(sideways.dtype).tiny)
    position = position - (weight * position).sum(dim=1, keepdim=True) / total
    return torch.where((weight * position * sideways).sum() < 0, -1.0, 1.0).to(sideways)


# Initial depths of the search for a bas-relief, as factors of the given one: a choice.
_DEPTHS = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)

_Curve = Callable[
    [Float[Tensor, "start 4"]], tuple[Float[Tensor, "start item"], Float[Tensor, "start item 4"]]
]


def relief_from_albedo(
    shading: Float[Tensor, "3 pixel"],
    weight: Float[Tensor, " pixel"],
    mask: Bool[Tensor, "height width"],
) -> BasRelief:
    """Find the bas-relief transformation after which most albedos are the same; convex.

    Levenberg-Marquardt from seven depths, with Cauchy's weights. Constant to autograd.

    Args:
        shading: Albedo times normal up to a bas-relief transformation, raster order.
    """
    x, y, z = shading.double()

    def curve(
        at: Float[Tensor, "start 4"],
    ) -> tuple[Float[Tensor, "start item"], Float[Tensor, "start item 4"]]:
        lam, mu, nu, scale = (one[:, None] for one in at.unbind(dim=1))
        u, v = lam * x - mu * z, lam * y - nu * z
        slopes = [2 * (u * x + v * y), -2 * u * z, -2 * v * z, 2 * scale * z * z]
        return u * u + v * v + (scale * z) ** 2, torch.stack(slopes, dim=-1)

    size = _typical(shading, weight)
    begin = [[depth / size, 0.0, 0.0, 1 / size] for depth in _DEPTHS]
    lam, mu, nu, scale = _fitted(curve, weight, x.new_tensor(begin), "pixels of equal albedo")
    found = BasRelief(mu=mu / scale, nu=nu / scale, lam=lam / scale)
    return convex(found, shading, weight, mask)


def relief_from_strength(
    lights: Float[Tensor, "view 3"],
    shading: Float[Tensor, "3 pixel"],
    weight: Float[Tensor, " pixel"],
    mask: Bool[Tensor, "height width"],
) -> BasRelief:
    """Find the bas-relief transformation that gives most point lights one strength; convex.

    Args:
        lights: Of the same factorization as the shading; zero rows are ignored.
        shading: As of :func:`relief_from_albedo`; it distinguishes convex from concave.
    """
    x, y, z = lights.double().unbind(dim=1)

    def curve(
        at: Float[Tensor, "start 4"],
    ) -> tuple[Float[Tensor, "start item"], Float[Tensor, "start item 4"]]:
        across, tilt_x, tilt_y, along = (one[:, None] for one in at.unbind(dim=1))
        height = tilt_x * x + tilt_y * y + along * z
        square = x * x + y * y
        slopes = [2 * across * square, 2 * height * x, 2 * height * y, 2 * height * z]
        return across**2 * square + height**2, torch.stack(slopes, dim=-1)

    known = (lights != 0).any(dim=1).to(lights)
    size = _typical(lights.mT, known)
    begin = [[depth / size, 0.0, 0.0, 1 / size] for depth in _DEPTHS]
    across, tilt_x, tilt_y, along = _fitted(
        curve, known, x.new_tensor(begin), "point lights of equal strength"
    )
    found = BasRelief(mu=tilt_x / across, nu=tilt_y / across, lam=along / across)
    return convex(found, shading, weight, mask)


def _typical(vectors: Float[Tensor, "3 item"], weight: Float[Tensor, " item"]) -> float:
    length = vectors.norm(dim=0)
    known = (weight > 0) & (length > 0)
    return float(length[known].median()) if bool(known.any()) else 1.0


def _fitted(
    curve: _Curve, weight: Float[Tensor, " item"], begin: Float[Tensor, "start 4"], what: str
) -> Float[Tensor, " 4"]:
    """Fit ``curve`` to 1 by Levenberg-Marquardt with Cauchy's weights, from several starts."""
    with torch.no_grad():
        given = weight.double()
        count = int((given > 0).sum())
        if count < 4:
            raise InputError(f"{what}: {count} are given; needed: four or more. Mark more.")
        at, damping = begin, torch.full_like(begin[:, 0], 1e-2)
        values, slopes = curve(at)
        eye = torch.eye(4).to(begin)
        for _ in range(60):
            residual = 1 - values
            scale = CAUCHY_TUNING * median_deviation(residual, (given > 0).expand_as(residual))
            scale = scale.clamp_min(1e-6)[:, None]
            heavy = given * cauchy_weights(residual, scale)
            normal = slopes.mT @ (heavy[..., None] * slopes)
            ridge = damping * normal.diagonal(dim1=1, dim2=2).mean(dim=1) + 1e-300
            rhs = (slopes * (heavy * residual)[..., None]).sum(dim=1)
            step = torch.linalg.solve(normal + ridge[:, None, None] * eye, rhs[..., None])[..., 0]
            moved = at + step
            after, steeper = curve(moved)
            better = _loss(1 - after, given, scale) < _loss(residual, given, scale)
            at = torch.where(better[:, None], moved, at)
            values = torch.where(better[:, None], after, values)
            slopes = torch.where(better[:, None, None], steeper, slopes)
            damping = (damping * torch.where(better, 0.2, 5.0)).clamp(1e-12, 1e12)
        # One scale for all, so that the starts' losses are comparable.
        scale = CAUCHY_TUNING * median_deviation(1 - values, (given > 0).expand_as(values)).amin()
        return at[int(_loss(1 - values, given, scale.clamp_min(1e-6)).argmin())]


def _loss(
    residual: Float[Tensor, "start item"],
    weight: Float[Tensor, " item"],
    scale: Float[Tensor, "*#batch"],
) -> Float[Tensor, " start"]:
    return (weight * scale**2 * torch.log1p((residual / scale) ** 2)).sum(dim=1)
