r"""Bas-relief resolved by pixels of one albedo or point lights of one strength.

Vectors of one length determine the quadratic form of lengths, of which bas-relief leaves four
entries: the transformation follows up to convex or concave.

Source: Hayakawa, Photometric stereo under a light source with arbitrary motion, JOSA A 11(11),
1994, for the form; that bas-relief and form have no more in common: Belhumeur, Kriegman & Yuille,
IJCV 35(1), 1999.
"""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.photometry.robust import CAUCHY_TUNING, cauchy_weights, median_deviation
from pimper_torch.single_view.factorization.bas_relief import BasRelief
from pimper_torch.single_view.photometric_stereo.relief import convex

# Initial depths of the search for a bas-relief, as factors of the given one: a choice.
_DEPTHS = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
_STEPS = 60

_Curve = Callable[
    [Float[Tensor, "start 4"]], tuple[Float[Tensor, "start item"], Float[Tensor, "start item 4"]]
]


def relief_from_albedo(
    shading: Float[Tensor, "3 pixel"],
    weight: Float[Tensor, " pixel"],
    mask: Bool[Tensor, "height width"],
) -> BasRelief:
    """Find the bas-relief transformation after which most albedos are the same; convex.

    Args:
        shading: Albedo times normal up to a bas-relief transformation, raster order.
        weight: Not negative.

    Levenberg-Marquardt from seven depths, with Cauchy's weights. Constant to autograd.
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
        shading: Albedo times normal up to a bas-relief transformation, raster order; it
            distinguishes convex from concave.

    Levenberg-Marquardt from seven depths, with Cauchy's weights. Constant to autograd.
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
        for _ in range(_STEPS):
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
