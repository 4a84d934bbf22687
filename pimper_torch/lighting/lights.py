r"""The light of every view, calibrated by the coarse mesh's normals.

Errors of the coarse mesh's normals are a few degrees. That is enough to calibrate lights, and with
calibrated lights the factorization has no ambiguity.

Three models are tried: soft light, which is first-order harmonics, constant over the scene; a near
point light with inverse-square falloff, attached shadows and an ambient term; and a near point
light in a lit room whose light is static in the world. Falloff and shadows of a point light are
not linear in :math:`(1, n)`: a fit of soft light would turn them, and a room's light, into shape.
Held-out radiance selects the model.
"""

import math
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from pimper_torch.geometry.rigid import invert_rigid, transform
from pimper_torch.lighting import light_models
from pimper_torch.lighting.light_colour import exposures, light_colours
from pimper_torch.lighting.light_field import LightField, harmonics, second_harmonics
from pimper_torch.lighting.light_fit import LightFit, fit_lights, with_gradients
from pimper_torch.lighting.light_models import ImageSamples, LightModel, SampleVectors
from pimper_torch.records import PatchSet, PatchViews, Templates

# Models by their number of parameters.
LightName = Literal["auto", "soft", "point_light", "room"]
_MODELS = "soft", "point_light", "room"

# Maximum number of views whose lights are fitted together: a choice, as time grows with its cube.
_TOGETHER = 80

# Maximum number of samples that the light is fitted to: a choice, 2,000 per parameter.
LIGHT_SAMPLES = 10_000


def thinned(patches: PatchSet) -> PatchSet:
    """Return templates with fewer rows and columns, enough for the fit of the light.

    The light can then be fitted before all views are resampled on all templates. Samples keep their
    positions, and all patches have samples: lights fitted to the same number of samples from every
    seventh patch had errors of 1.3 degrees in the median view of the skull, against 0.2 degrees
    with samples from all patches.
    """
    count = sum(int((each.barycentric >= 0).all(dim=-1).sum()) for each in patches.buckets)
    step = max(1, math.isqrt(count // (2 * LIGHT_SAMPLES)))  # twice, as views miss samples
    return patches.replace(buckets=tuple(_subsampled(each, step) for each in patches.buckets))


def light_of_mesh(
    seen: PatchViews,
    coarse: list[Float[Tensor, "_ _ _ 3"]],
    min_views: int,
    model: LightName,
    colours: bool = True,
) -> LightField:
    """Fit the light field to samples evenly spread over the facets, without their overlap.

    Its lights are those of radiance divided by the views' colours and exposures.

    Args:
        seen: Samples of all patches; templates may be :func:`thinned`.
        coarse: Normals of each bucket's templates, patch frame.
        min_views: Number of views a sample must be valid in.
        model: See :func:`fit_light_field`.
        colours: Whether views may differ in the colour of their light and in exposure.

    Differentiable in radiance, normals and templates; the selection of samples is constant.
    """
    chosen = [
        (templates.barycentric >= 0).all(dim=-1) & (registered.valid.sum(dim=1) >= min_views)
        for templates, registered in zip(seen.patches.buckets, seen.buckets, strict=True)
    ]
    stride = max(1, -(-sum(int(each.sum()) for each in chosen) // LIGHT_SAMPLES))
    radiance, visible, normals, points = [], [], [], []
    for templates, registered, bucket_normals, mask in zip(
        seen.patches.buckets, seen.buckets, coarse, chosen, strict=True
    ):
        patch, row, column = (index[::stride] for index in mask.nonzero(as_tuple=True))
        sampled = registered.radiance[patch, :, :, row, column]
        finite = sampled.isfinite().all(dim=2)
        radiance.append(templates.among_all(torch.where(finite[..., None], sampled, 0)))
        seen_by = registered.valid[patch, :, row, column] & finite
        visible.append(templates.among_all(seen_by))
        to_world = templates.patch_from_world[patch, :3, :3].to(bucket_normals)
        normals.append((bucket_normals[patch, row, column, None] @ to_world)[:, 0])
        positions = templates.points_patch[patch, row, column, None]
        points.append(transform(invert_rigid(templates.patch_from_world[patch]), positions)[:, 0])
    samples, observed = torch.cat(radiance), torch.cat(visible)
    colour = samples.new_ones(samples.shape[1:])
    exposure = colour[:, 0]
    if colours:
        colour = light_colours(samples, observed)
        exposure = exposures((samples / colour).mean(dim=2), observed)
    gray = (samples / colour).mean(dim=2) / exposure
    field = fit_light_field(gray, observed, torch.cat(normals), torch.cat(points), model=model)
    return field.replace(gain=colour * exposure[:, None], exposure=exposure)


def fit_light_field(
    radiance: light_models.Entries,
    seen: light_models.Seen,
    normals: SampleVectors,
    points: SampleVectors | None = None,
    model: LightName = "auto",
    iterations: int = 60,
) -> LightField:
    r"""Return the fit of soft light, point lights, or point lights in a lit room.

    Minimizes :math:`\sum_{ig} \phi(x_{gi} - \rho_i\, s_g(i))` with Cauchy's loss :math:`\phi`,
    at a scale of 2.385 robust deviations of the view's residuals (wider at first).

    Args:
        radiance: Gray, linear. Entries that are not seen are ignored.
        seen: False where missing.
        normals: Unit, world.
        points: World; without them, point lights are distant.
        model: Model to fit; ``auto`` tries all with a fifth of the radiance held out, and selects
            the simplest one that no model with more parameters significantly outperforms.
        iterations: Maximum number for each model.

    More than 80 views are fitted in groups of evenly spaced views, which the albedo that they have
    in common brings to one scale; the first group selects the model.

    Returns:
        The scale between light and albedo is free: the median of ``|l|`` over the views, at the
        centroid of the points, is set to 1. The light of a view without data is zero.

    Fails if the normals span too little (a plane determines one coefficient of each soft light):
    the result is then the smallest change from lights along the mean normal, and all lights are
    nearly parallel. Computed in float64. Differentiable by the implicit function theorem; the
    choice of the model, the room's harmonics over its ambient light, and parameters at a bound are
    constant.

    Source: of the point light, Queau et al., LED-based photometric stereo, JMIV 60, 2018; its
    calibration by the coarse shape is ours.
    """
    views = radiance.shape[1]
    if not seen.any():
        return LightField(
            origin=radiance.new_zeros(3),
            soft=radiance.new_zeros(views, 9),
            point_light=radiance.new_zeros(views, 3),
            inverse_distance=radiance.new_zeros(views),
        )
    mask = seen.any(dim=1)
    seen = seen[mask]
    samples = ImageSamples(radiance=torch.where(seen, radiance[mask], 0).double(), seen=seen)
    unit_normals = normals[mask].double()
    positions = torch.zeros_like(unit_normals) if points is None else points[mask].double()
    origin = positions.mean(dim=0)
    offsets = positions - origin
    away = offsets[(offsets != 0).any(dim=1)]
    size = away.norm(dim=1).sum() / len(offsets) if len(away) else offsets.new_ones(())
    geometry = unit_normals, offsets / size
    step = -(-views // _TOGETHER)
    groups = [samples.at((slice(None), slice(first, None, step))) for first in range(step)]
    name = _selected(groups[0], *geometry, iterations) if model == "auto" else model
    fits = [_lights(name, group, *geometry, iterations) for group in groups]
    scales = [fits[0][2].new_ones(())]
    for _, _, albedo, _ in fits[1:]:
        common = (albedo > 0) & (fits[0][2] > 0)
        ratio = albedo[common] / fits[0][2][common]
        scales.append(ratio.median() if len(ratio) else scales[0])
    order = torch.cat([torch.arange(first, views, step) for first in range(step)]).argsort()
    lights, point_lights = (
        torch.cat([scale * fit[column] for scale, fit in zip(scales, fits, strict=True)])[order]
        for column in (0, 1)
    )
    relative = torch.cat([fit[3] for fit in fits])[order]
    inverse_distance = torch.zeros_like(relative) if points is None else relative / size
    square = lights.square().sum(dim=1) + point_lights.square().sum(dim=1)
    factor = square[square > 0].sqrt().median().nan_to_num(nan=1.0)
    return LightField(
        origin=origin.to(radiance),
        soft=(lights / factor).to(radiance),
        point_light=(point_lights / factor).to(radiance),
        inverse_distance=inverse_distance.to(radiance),
    )


def _lights(
    name: str, samples: ImageSamples, normals: SampleVectors, points: SampleVectors, iterations: int
) -> tuple[
    Float[Tensor, "view 9"], Float[Tensor, "view 3"], light_models.Albedo, Float[Tensor, " view"]
]:
    """Return fitted harmonics, point lights, albedo, and inverse distances in units of points."""
    fit, mixing = _fit(name, samples, normals, points, iterations)
    fitted, terms = with_gradients(fit, samples), len(mixing)
    solution = fitted.lights
    lights = solution[:, :terms] @ mixing
    point_lights, inverse_distance = torch.zeros_like(lights[:, :3]), torch.zeros_like(lights[:, 0])
    if name != "soft":
        point_lights, inverse_distance = solution[:, terms:-1], solution[:, -1]
    return lights, point_lights, fitted.albedo, inverse_distance


def _fit(
    name: str, samples: ImageSamples, normals: SampleVectors, points: SampleVectors, iterations: int
) -> tuple[LightFit, Float[Tensor, "term 9"]]:
    """Return the fit of a model, and the harmonics that each soft coefficient multiplies."""
    basis = torch.cat([harmonics(normals), second_harmonics(normals)], dim=1)
    eye = torch.eye(9).to(basis)
    if name == "soft":
        return fit_lights(LightModel(basis=basis[:, :4]), samples, iterations), eye[:4]
    model = LightModel(basis=basis[:, :1], normals=normals, points=points)
    fit = fit_lights(model, samples, iterations)
    if name == "point_light":
        return fit, eye[:1]
    room = eye[:1]
    for _ in range(8):
        room = _fit_room(fit, samples, basis, room)
        model = LightModel(basis=basis @ room.mT, normals=normals, points=points)
        fit = fit_lights(model, samples, iterations, (fit.lights, fit.albedo))
    return fit, room


@torch.no_grad()
def _fit_room(
    fit: LightFit,
    samples: ImageSamples,
    basis: Float[Tensor, "sample 9"],
    room: Float[Tensor, "1 9"],
) -> Float[Tensor, "1 9"]:
    """Return the room's harmonics after a Gauss-Newton step of them and the albedos."""
    albedo, ambient = fit.albedo, fit.lights[:, 0]
    shading = fit.model.shade(fit.lights)
    residual = samples.residual(albedo, shading)
    weight = samples.weights(residual, samples.scale(residual))
    slope = basis[:, 1:] * albedo[:, None]
    diagonal = (weight * shading**2).sum(dim=1).clamp_min(1e-300)
    cross = slope * ((weight * shading) @ ambient)[:, None]
    full = slope.mT @ (slope * (weight @ ambient**2)[:, None])
    matrix = full - cross.mT @ (cross / diagonal[:, None])
    side = slope.mT @ ((weight * residual) @ ambient)
    side = side - cross.mT @ ((weight * residual * shading).sum(dim=1) / diagonal)
    # If all views have one light, albedo explains the room, and the matrix is only rounding error:
    # 1e-16 of the terms that were subtracted.
    floor = torch.maximum(1e-6 * matrix.diagonal().mean(), 1e-12 * full.diagonal().mean())
    step = torch.linalg.solve(matrix + floor.clamp_min(1e-300) * torch.eye(8).to(matrix), side)
    return room + pad(step, (1, 0))


@torch.no_grad()
def _selected(
    samples: ImageSamples, normals: SampleVectors, points: SampleVectors, iterations: int
) -> str:
    """Return the model selected by its residuals of held-out radiance."""
    subset = slice(None, None, -(-len(normals) // 2500))
    normals, points = normals[subset], points[subset]
    all_samples = samples.at(subset)
    test = light_models.left_out(all_samples.seen)
    seen = all_samples.seen & ~test
    rest = ImageSamples(radiance=torch.where(seen, all_samples.radiance, 0), seen=seen)
    best, least = "", torch.empty(0)
    for name in _MODELS:
        misfit = _fit(name, rest, normals, points, iterations)[0].misfit(all_samples, test)
        if not best or light_models.predicts_better(misfit, least):
            best, least = name, misfit
    return best


def _subsampled(templates: Templates, step: int) -> Templates:
    height, width = templates.depth.shape[1:]
    step = max(1, min(step, height // 2, width // 2))
    first = (step - 1) // 2
    raster = (slice(None), slice(first, None, step), slice(first, None, step))
    normals = templates.normals_patch
    return templates.replace(
        origin=templates.origin + first * templates.spacing[:, None],
        spacing=step * templates.spacing,
        depth=templates.depth[raster],
        barycentric=templates.barycentric[raster],
        inside=templates.inside[raster],
        normals_patch=None if normals is None else normals[raster],
    )
