r"""Metric upgrade of rank-three factorizations by pixels of one albedo or lights of one strength.

Six pixels of equal albedo, or six point lights of equal strength, determine the quadratic form of
their lengths; its ambiguity is an orthogonal matrix. Where the ambiguity is a bas-relief
transformation, they resolve it up to convex or concave.

Source: Hayakawa, Photometric stereo under a light source with arbitrary motion, JOSA A 11(11),
1994, for the form; that bas-relief and form have no more in common: Belhumeur, Kriegman & Yuille,
IJCV 35(1), 1999.
"""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.photometry.quadratics import diagonal, outer, unpacked
from pimper_torch.photometry.robust import CAUCHY_TUNING, cauchy_weights, median_deviation
from pimper_torch.single_view.factorization.bas_relief import BasRelief
from pimper_torch.single_view.photometric_stereo.relief import convex

_ITERATIONS = 20
# Minimum singular value of the equations, as a fraction of the largest: below, the vectors lie on
# a cone, and the form is not unique. A choice.
_MIN_FRACTION = 1e-6
# Initial depths of the search for a bas-relief, as factors of the given one: a choice.
_DEPTHS = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
_STEPS = 60

_Curve = Callable[
    [Float[Tensor, "start 4"]], tuple[Float[Tensor, "start item"], Float[Tensor, "start item 4"]]
]


def metric_from_albedo(
    shading: Float[Tensor, "3 pixel"], weight: Float[Tensor, " pixel"]
) -> Float[Tensor, "3 3"]:
    r"""Find the matrix after which shading has length 1 wherever there is weight.

    :math:`\lVert A s_k \rVert = 1` is linear in :math:`A^\top A`; Cauchy's weights reject pixels of
    another albedo, as long as they are few. The remaining ambiguity is an orthogonal matrix.

    Args:
        shading: Up to an invertible matrix.
        weight: Not negative; 0 leaves a pixel out.

    Returns:
        ``A``, to be applied to shading. Its inverse goes to the lights.

    Raises:
        InputError: Fewer than six pixels, or pixels for which there is no form, or several.
    """
    return _root(_form(shading, weight, "pixels of equal albedo"), "pixels of equal albedo")


def metric_from_strength(lights: Float[Tensor, "view 3"]) -> Float[Tensor, "3 3"]:
    r"""Find the matrix after which all point lights have the same strength.

    :math:`\lVert A^{-\top} l_v \rVert = 1` for all point lights is linear in
    :math:`A^{-1} A^{-\top}`. The remaining ambiguity is an orthogonal matrix.

    Args:
        lights: Up to an invertible matrix; zero rows are ignored.

    Returns:
        ``A``, to be applied to shading. Its inverse goes to the lights.

    Raises:
        InputError: Fewer than six point lights, point lights on one cone, or point lights that
            cannot have one strength.
    """
    weight = (lights != 0).any(dim=1).to(lights)
    form = _form(lights.mT, weight, "point lights of equal strength")
    return torch.linalg.inv(_root(form, "point lights of equal strength")).mT


def relief_from_albedo(
    shading: Float[Tensor, "3 pixel"],
    weight: Float[Tensor, " pixel"],
    mask: Bool[Tensor, "height width"],
) -> BasRelief:
    """Find the bas-relief transformation after which most albedos are the same; convex.

    Args:
        shading: Albedo times normal up to a bas-relief transformation, raster order.
        weight: Not negative.

    Raises:
        InputError: Fewer than four pixels.

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

    Raises:
        InputError: Fewer than four point lights.

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


def _form(
    vectors: Float[Tensor, "3 item"], weight: Float[Tensor, " item"], what: str
) -> Float[Tensor, "3 3"]:
    """Find the quadratic form under which vectors have length 1, by reweighted least squares."""
    with torch.no_grad():
        given = weight.double()
        count = int((given > 0).sum())
        if count < 6:
            raise InputError(f"{what}: {count} are given; needed: six or more. Mark more.")
        size = _typical(vectors, weight)
        double = torch.full((6, 1), 2.0).to(given)
        double[diagonal(3)] = 1
        monomials = double * outer(vectors.double() / size)
        heavy = given
        for _ in range(_ITERATIONS):
            root = heavy.sqrt()
            singular = torch.linalg.svdvals(root * monomials)
            if not singular[-1] > _MIN_FRACTION * singular[0]:
                raise InputError(
                    f"{what}: theirs are on one cone, so that more than one quadratic form makes "
                    "them equal; needed: others besides. Take more, in other directions."
                )
            entries = torch.linalg.lstsq(
                (root * monomials).mT, root[:, None], driver="gelsd"
            ).solution[:, 0]
            residual = entries @ monomials - 1
            scale = CAUCHY_TUNING * median_deviation(residual, given > 0)
            heavy = given * cauchy_weights(residual, scale)
        return unpacked(entries[:, None], 3)[0].to(vectors) / size**2


def _root(form: Float[Tensor, "3 3"], what: str) -> Float[Tensor, "3 3"]:
    """Split ``B = A^T A``."""
    factor, failed = torch.linalg.cholesky_ex(form)
    if int(failed) != 0:
        raise InputError(
            f"{what}: no quadratic form makes them equal (the best one is not positive definite); "
            "needed: what is equal. Leave the others out, or resolve the ambiguity otherwise."
        )
    return factor.mT


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
