r"""Bas-relief resolved by local maxima of diffuse shading.

At a local maximum of brightness under one point light, on a surface of one paint, the normal points
to the point light: albedo times normal is parallel to the light. For a factorization right up to
a bas-relief transformation this reads

.. math:: \hat l \times M \hat b = 0, \qquad M = G^\top G,

two independent equations per maximum, linear in the four entries of the metric: two maxima
determine it in closed form. Maxima are also found where paint changes, along ridges and beside
shadows; these outliers are rejected by consensus.

Source: Favaro & Papadhimitri, A closed-form solution to uncalibrated photometric stereo via
diffuse maxima, CVPR 2012; Papadhimitri & Favaro, IJCV 107(2), 2014.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d, pad

from pimper_torch.errors import InputError
from pimper_torch.photometry.robust import cauchy_weights
from pimper_torch.records import Record
from pimper_torch.single_view.factorization.bas_relief import BasRelief
from pimper_torch.single_view.photometric_stereo.factors import (
    cast,
    require_matching,
    require_standard,
    usable_pixels,
)
from pimper_torch.single_view.photometric_stereo.relief_metric import relief_of_metric

# Maxima whose pairs are tried: a choice; pairs are half their square.
_MAX_MAXIMA = 120
_REFINEMENTS = 30
# Fraction of a view's brightest value below which a pixel may be in shadow: a choice.
_SHADOW = 0.05
# Expected fraction of inliers among the maxima: a choice; on one paint it is higher.
_INLIER_FRACTION = 0.2
# Maximum logarithm of lambda from the standard form: a choice, hardly a surface is flatter.
_MAX_LOG_LAMBDA = 2.0
# Other point lights, by which the likelihood of chance agreement is estimated: a choice.
_CHANCE_LIGHTS = 10


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class DiffuseMaxima(Record):
    """Local maxima of brightness under one point light.

    Attributes:
        view: Of the point light.
        pixel: Column and row, top-left centre at (0.5, 0.5).
        shading: Albedo times normal there, interpolated.
        deviation: Standard deviation of the vector's direction, from that of the maximum's
            position under the residuals of its quadratic; radians.
    """

    view: Int[Tensor, " maximum"]
    pixel: Float[Tensor, "maximum 2"]
    shading: Float[Tensor, "3 maximum"]
    deviation: Float[Tensor, " maximum"]


def resolve_by_diffuse_maxima(
    images: Float[Tensor, "view channel height width"],
    mask: Bool[Tensor, "height width"],
    shading: Float[Tensor, "3 pixel"],
    lights: Float[Tensor, "view 3"],
    *,
    radius: int = 3,
    agreement_deg: float = 1.0,
) -> BasRelief:
    r"""Find the bas-relief transformation that aligns normals at maxima with their point lights.

    Every pair of maxima gives a metric in closed form, the least singular vector of its six
    equations. The one of highest consensus is refined on all maxima: in the frame of the current
    solution, where ``M`` is near the identity, the equations are sines of the angles between
    normals and lights, and are solved with Cauchy's weights until convergence.

    Args:
        images: Linear radiance.
        shading: Albedo times normal of the pixels inside the mask, right up to a bas-relief
            transformation.
        lights: Of the same factorization.
        radius: Of the square in pixels in which a maximum is the largest value, and which lies
            inside the mask and out of shadow.
        agreement_deg: Expected angle between normal and light of a maximum whose position is
            exact.

    Returns:
        The transformation with lambda above zero: convex stays convex. Constant to autograd.

    Fails where fewer than about three point lights have a maximum on the visible surface, and
    where albedo varies more than the shading everywhere.

    Raises:
        InputError: Sizes that do not fit, fewer than two maxima, or none that agree.

    Source: Favaro & Papadhimitri, CVPR 2012 and IJCV 107(2), 2014, for the equations. They
    select among the solutions of pairs otherwise; the consensus, the refinement and the
    localization by quadratics are ours.
    """
    require_matching(images, mask, shading, lights)
    with torch.no_grad():
        start = require_standard(shading[:, usable_pixels(shading)])
        maxima = find_maxima(images, mask, start.on_shading(shading.double()), radius)
        if len(maxima.view) < 2:
            raise InputError(
                f"{len(maxima.view)} maxima of brightness found in {len(images)} views; needed: "
                "two at least, in different places. Lower `radius`, or use another method."
            )
        best = maxima.deviation.argsort()[:_MAX_MAXIMA]
        light = start.on_lights(lights.double())[maxima.view[best]].mT
        floor = torch.deg2rad(maxima.deviation.new_tensor(agreement_deg))
        scale = (maxima.deviation[best].square() + floor * floor).sqrt()
        found = _consensus(maxima.shading[:, best], light, scale).after(start)
        return cast(found, shading)


def find_maxima(
    images: Float[Tensor, "view channel height width"],
    mask: Bool[Tensor, "height width"],
    shading: Float[Tensor, "3 pixel"],
    radius: int = 3,
) -> DiffuseMaxima:
    """Find local maxima of brightness inside the surface, to a fraction of a pixel.

    A quadratic is fitted to the square around the largest value. Those with a maximum within the
    square are kept; shading is interpolated by a plane fitted to the same square.

    Args:
        images: Linear radiance; channels are added.
        mask: The whole square must lie inside.
        shading: Of the pixels inside the mask. Deviations are angles in its frame, so it should
            be about Euclidean.
    """
    found = [_local_maxima(image.sum(dim=0), mask, radius) for image in images]
    counts = torch.tensor([len(tops) for tops in found], device=mask.device)
    view = torch.arange(len(images), device=mask.device).repeat_interleave(counts)
    row, column = torch.cat(found).mT
    raster = torch.zeros(3, *mask.shape, dtype=torch.float64, device=mask.device)
    raster[:, mask] = shading.double().nan_to_num()
    y, x = _offsets(radius, mask)
    rows, columns = row[:, None] + y, column[:, None] + x
    window = images[view[:, None], :, rows, columns].double().sum(dim=-1)
    u, v = x.double(), y.double()
    one = torch.ones_like(u)
    basis = torch.stack([one, u, v, u * u / 2, u * v, v * v / 2], dim=1)
    fitted = torch.linalg.lstsq(basis, window.mT, driver="gelsd").solution
    _, gx, gy, hxx, hxy, hyy = fitted
    determinant = hxx * hyy - hxy * hxy
    safe = torch.where(determinant > 0, determinant, 1)
    du, dv = -(hyy * gx - hxy * gy) / safe, -(hxx * gy - hxy * gx) / safe
    kept = (determinant > 0) & (hxx < 0) & (torch.maximum(du.abs(), dv.abs()) < radius)
    error = (window.mT - basis @ fitted).square().sum(dim=0) / (len(basis) - basis.shape[1])
    plane = torch.linalg.lstsq(
        basis[:, :3], raster[:, rows, columns].permute(2, 0, 1).flatten(1), driver="gelsd"
    )
    level, along, down = plane.solution.reshape(3, 3, -1)
    vector = level + along * du + down * dv
    # An error of the gradient moves the maximum by minus the inverse Hessian times it.
    by_gx = -(hyy * along - hxy * down) / safe
    by_gy = -(hxx * down - hxy * along) / safe
    size = vector.norm(dim=0).clamp_min(1e-30)
    unit = vector / size
    rotation = sum(
        (by - unit * (unit * by).sum(dim=0)).square().sum(dim=0) for by in (by_gx, by_gy)
    )
    deviation = (error / (u * u).sum() * rotation).sqrt() / size
    pixel = torch.stack([column + 0.5 + du, row + 0.5 + dv], dim=1)
    return DiffuseMaxima(
        view=view[kept], pixel=pixel[kept], shading=vector[:, kept], deviation=deviation[kept]
    )


def _consensus(
    b: Float[Tensor, "3 maximum"],
    light: Float[Tensor, "3 maximum"],
    scale: Float[Tensor, " maximum"],
) -> BasRelief:
    """Select the pair's transformation of highest consensus, and refine it."""
    equations = _equations(b, light)
    one, other = torch.triu_indices(b.shape[1], b.shape[1], 1, device=b.device)
    pairs = torch.cat([equations[one], equations[other]], dim=1)
    metrics = torch.linalg.svd(pairs, full_matrices=False).Vh[:, -1]
    reliefs = relief_of_metric(metrics)
    angles = _angles(reliefs, b, light).nan_to_num(nan=torch.pi)
    # Likelihood ratio of an inlier against the point light of some other maximum: transformations
    # that make all normals or all lights parallel give every pair a small angle.
    likelihood = torch.exp(-((angles / scale) ** 2) / 2)
    chance = torch.zeros_like(likelihood)
    shifts = range(1, min(_CHANCE_LIGHTS, b.shape[1] - 1) + 1)
    for shift in shifts:
        other = _angles(reliefs, b, light.roll(shift, dims=1)).nan_to_num(nan=torch.pi)
        chance += torch.exp(-((other / scale) ** 2) / 2) / len(shifts)
    # The second term is the likelihood of chance on the whole sphere.
    likelier = likelihood / (chance + scale**2 / 2)
    support = (_INLIER_FRACTION * likelier).log1p().sum(dim=1)
    extreme = reliefs.lam.log().abs().nan_to_num(nan=99.0) > _MAX_LOG_LAMBDA
    support = torch.where(extreme, 0, support)
    best = int(support.argmax())
    if int((angles[best] < 3 * scale).sum()) < 2 or bool(extreme[best]):
        raise InputError(
            f"no two of {b.shape[1]} maxima of brightness agree on one transformation; needed: "
            "pixels that face their point lights. Lower `radius`, or use another method."
        )
    return _refined(
        BasRelief(mu=reliefs.mu[best], nu=reliefs.nu[best], lam=reliefs.lam[best]), b, light, scale
    )


def _refined(
    relief: BasRelief,
    b: Float[Tensor, "3 maximum"],
    light: Float[Tensor, "3 maximum"],
    scale: Float[Tensor, " maximum"],
) -> BasRelief:
    """Solve all maxima's equations in the frame of the last solution, until convergence."""
    for _ in range(_REFINEMENTS):
        moved = relief.on_shading(b)
        point_light = relief.on_lights(light.mT).mT
        weight = cauchy_weights(_angles(relief, b, light), scale) / scale**2
        equations = weight[:, None, None].sqrt() * _equations(moved, point_light)
        metric = torch.linalg.svd(equations.flatten(0, 1), full_matrices=False).Vh[-1]
        step = relief_of_metric(metric)
        if not bool(step.lam.isfinite()):
            return relief
        relief = step.after(relief)
        if float((step.matrix - torch.eye(3).to(b)).abs().max()) < 1e-10:
            break
    return relief


def _equations(
    b: Float[Tensor, "3 maximum"], light: Float[Tensor, "3 maximum"]
) -> Float[Tensor, "maximum 3 4"]:
    """Return ``l x M b = 0`` by the metric's entries, both vectors made unit."""
    x, y, z = b / b.norm(dim=0).clamp_min(1e-30)
    l1, l2, l3 = light / light.norm(dim=0).clamp_min(1e-30)
    zero = torch.zeros_like(x)
    # M b = (m0 x + m1 z, m0 y + m2 z, m1 x + m2 y + m3 z).
    rows = [
        torch.stack([-l3 * y, l2 * x, l2 * y - l3 * z, l2 * z], dim=1),
        torch.stack([l3 * x, l3 * z - l1 * x, -l1 * y, -l1 * z], dim=1),
        torch.stack([l1 * y - l2 * x, -l2 * z, l1 * z, zero], dim=1),
    ]
    return torch.stack(rows, dim=1)


def _angles(
    relief: BasRelief, b: Float[Tensor, "3 maximum"], light: Float[Tensor, "3 maximum"]
) -> Float[Tensor, "*batch maximum"]:
    """Return the angle between each normal and its light after the transformation."""
    normal, point_light = relief.matrix @ b, relief.inverse().matrix.mT @ light
    cross = torch.linalg.cross(normal, point_light, dim=-2).norm(dim=-2)
    return torch.atan2(cross, (normal * point_light).sum(dim=-2))


def _local_maxima(
    image: Float[Tensor, "height width"], mask: Bool[Tensor, "height width"], radius: int
) -> Int[Tensor, "top 2"]:
    """Find rows and columns of local maxima, their squares inside the mask and out of shadow.

    The image is blurred by the binomial kernel of five first, to remove maxima of noise.
    """
    kernel = image.new_tensor([1.0, 4, 6, 4, 1]) / 16
    smooth = conv2d(image[None, None], (kernel[:, None] * kernel)[None, None], padding=2)
    side = 2 * radius + 1
    good = (mask & (image > _SHADOW * image.max())).to(image)
    inside = -max_pool2d(-pad(good, (radius,) * 4)[None, None], side, stride=1) > 0
    top = max_pool2d(smooth, side, stride=1, padding=radius) == smooth
    return (top & inside)[0, 0].nonzero()


def _offsets(radius: int, like: Tensor) -> tuple[Int[Tensor, " offset"], Int[Tensor, " offset"]]:
    side = torch.arange(-radius, radius + 1, device=like.device)
    y, x = torch.meshgrid(side, side, indexing="ij")
    return y.flatten(), x.flatten()
