r"""The light of every view, calibrated by the coarse mesh's normals.

Normals of the coarse mesh are right to a few degrees; that is enough to calibrate lights, and
calibrated lights leave the factorization no ambiguity.

Three models are tried: soft light, first-order harmonics that are constant over the scene; a near
point light with inverse-square falloff, attached shadows and an ambient term; and a near point
light in a lit room, whose light is at rest in the world. Falloff and shadows of a point light are
not linear in :math:`(1, n)`: fitted by soft light, they would appear as shape; and so would the
room's light. Radiance that is left out of the fits decides.
"""

import math
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from pimper_torch.ground.geometry.rigid import invert_rigid, transform
from pimper_torch.method.photometry import light_models
from pimper_torch.method.photometry.light_colour import exposures, light_colours
from pimper_torch.method.photometry.light_field import LightField, harmonics, second_harmonics
from pimper_torch.method.photometry.light_fit import LightFit, fit_lights, with_gradients
from pimper_torch.method.photometry.light_models import ImageSamples, LightModel, SampleVectors
from pimper_torch.records import PatchSet, PatchViews, Templates

# Models by their number of parameters.
LightName = Literal["auto", "soft", "point_light", "room"]
_MODELS = "soft", "point_light", "room"

# Maximum number of views whose lights are fitted together, as time grows with its cube: a choice.
_TOGETHER = 80

# Maximum number of samples that the light is fitted to: a choice, 2,000 per parameter.
LIGHT_SAMPLES = 10_000


def thinned(patches: PatchSet) -> PatchSet:
    """Subsample each template's raster, as densely as fitting the light needs.

    Light can so be fitted before all views are resampled on all templates. All patches keep some
    samples: lights fitted to as many samples of every seventh patch alone were 1.3 degrees off in
    the median view of the skull, those fitted to samples of all patches 0.2.

    Returns:
        Templates with fewer rows and columns; the samples have the same positions.
    """
    own = sum(int((each.barycentric >= 0).all(dim=-1).sum()) for each in patches.buckets)
    step = max(1, math.isqrt(own // (2 * LIGHT_SAMPLES)))  # some samples are in no view
    return patches.replace(buckets=tuple(_subsampled(each, step) for each in patches.buckets))


def light_of_mesh(
    seen: PatchViews,
    coarse: list[Float[Tensor, "_ _ _ 3"]],
    min_views: int,
    model: LightName,
    colours: bool = True,
) -> LightField:
    """Fit the light field to samples spread evenly over the facets, without their overlap.

    Its lights are those of radiance over the views' colours and exposures.

    Args:
        seen: All views on all templates, :func:`thinned` or not.
        coarse: Normals of each bucket's templates, patch frame.
        min_views: Views a sample must be valid in.
        model: See :func:`fit_light_field`.
        colours: Whether views may have light of unlike colour and be exposed unlike.

    Differentiable in radiance, normals and templates; which samples are taken is constant.
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
        patch, row, column = (part[::stride] for part in mask.nonzero(as_tuple=True))
        sampled = registered.radiance[patch, :, :, row, column]
        finite = sampled.isfinite().all(dim=2)
        radiance.append(templates.among_all(torch.where(finite[..., None], sampled, 0)))
        seen_by = registered.valid[patch, :, row, column] & finite
        visible.append(templates.among_all(seen_by))
        to_world = templates.patch_from_world[patch, :3, :3].to(bucket_normals)
        normals.append((bucket_normals[patch, row, column, None] @ to_world)[:, 0])
        positions = templates.points_patch[patch, row, column, None]
        points.append(transform(invert_rigid(templates.patch_from_world[patch]), positions)[:, 0])
    every, shown = torch.cat(radiance), torch.cat(visible)
    colour = every.new_ones(every.shape[1:])
    exposure = colour[:, 0]
    if colours:
        colour = light_colours(every, shown)
        exposure = exposures((every / colour).mean(dim=2), shown)
    gray = (every / colour).mean(dim=2) / exposure
    field = fit_light_field(gray, shown, torch.cat(normals), torch.cat(points), model=model)
    return field.replace(gain=colour * exposure[:, None], exposure=exposure)


def fit_light_field(
    radiance: light_models.Entries,
    seen: light_models.Seen,
    normals: SampleVectors,
    points: SampleVectors | None = None,
    model: LightName = "auto",
    iterations: int = 60,
) -> LightField:
    r"""Fit soft light, point lights, or point lights in a lit room.

    Minimizes :math:`\sum_{ig} \phi(x_{gi} - \rho_i\, s_g(i))`, :math:`\phi` being Cauchy's
    loss with a scale of 2.385 robust deviations of the view's residuals (wider at first).

    Args:
        radiance: Gray, linear. Entries that are not seen are ignored.
        seen: False where missing.
        normals: Unit, world.
        points: World; without them, point lights are distant.
        model: Which to fit; ``auto`` tries all with a fifth of the radiance left out, and selects
            the simplest that none with more parameters predicts better than, significantly.
        iterations: At most, for each model.

    Lights of more than 80 views are fitted in groups, of every so many-th view, and brought to one
    scale by the albedo that the groups have in common; the model is selected by the first of them.

    Returns:
        The scale between light and albedo is free; here the median of ``|l|`` over the views,
        at the centroid of the points, is 1. A view without data has zero light.

    Fails where the normals span too little (a plane determines one coefficient of each soft
    light): the result is then the smallest change from lights along the mean normal, so that all
    lights are nearly parallel. Computed in float64. Differentiable by the implicit function; the
    choice of the model, the room's harmonics over its ambient light, and the parameters at a
    bound, are constant.

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
    some = seen.any(dim=1)
    seen = seen[some]
    samples = ImageSamples(radiance=torch.where(seen, radiance[some], 0).double(), seen=seen)
    own_normals = normals[some].double()
    positions = torch.zeros_like(own_normals) if points is None else points[some].double()
    origin = positions.mean(dim=0)
    offsets = positions - origin
    away = offsets[(offsets != 0).any(dim=1)]
    size = away.norm(dim=1).sum() / len(offsets) if len(away) else offsets.new_ones(())
    geometry = own_normals, offsets / size
    step = -(-views // _TOGETHER)
    groups = [samples.at((slice(None), slice(first, None, step))) for first in range(step)]
    name = _selected(groups[0], *geometry, iterations) if model == "auto" else model
    fits = [_lights(name, group, *geometry, iterations) for group in groups]
    scales = [fits[0][2].new_ones(())]
    for _, _, albedo, _ in fits[1:]:
        both = (albedo > 0) & (fits[0][2] > 0)
        ratio = albedo[both] / fits[0][2][both]
        scales.append(ratio.median() if len(ratio) else scales[0])
    order = torch.cat([torch.arange(first, views, step) for first in range(step)]).argsort()
    lights, point_lights = (
        torch.cat([scale * each[part] for scale, each in zip(scales, fits, strict=True)])[order]
        for part in (0, 1)
    )
    inverse_distance = torch.cat([each[3] for each in fits])[order]
    inverse_distance = (
        torch.zeros_like(inverse_distance) if points is None else inverse_distance / size
    )
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
    """Return fitted harmonics, point lights, albedo, and closeness, in units of the points."""
    found, mixing = _fit(name, samples, normals, points, iterations)
    fitted, terms = with_gradients(found, samples), len(mixing)
    solution = fitted.lights
    lights = solution[:, :terms] @ mixing
    point_lights, inverse_distance = torch.zeros_like(lights[:, :3]), torch.zeros_like(lights[:, 0])
    if name != "soft":
        point_lights, inverse_distance = solution[:, terms:-1], solution[:, -1]
    return lights, point_lights, fitted.albedo, inverse_distance


def _fit(
    name: str, samples: ImageSamples, normals: SampleVectors, points: SampleVectors, iterations: int
) -> tuple[LightFit, Float[Tensor, "term 9"]]:
    """Fit a model.

    Returns:
        The fit, and the harmonics that each coefficient of its soft light multiplies.
    """
    basis = torch.cat([harmonics(normals), second_harmonics(normals)], dim=1)
    each = torch.eye(9).to(basis)
    if name == "soft":
        return fit_lights(LightModel(basis=basis[:, :4]), samples, iterations), each[:4]
    model = LightModel(basis=basis[:, :1], normals=normals, points=points)
    found = fit_lights(model, samples, iterations)
    if name == "point_light":
        return found, each[:1]
    room = each[:1]
    for _ in range(8):
        room = _fit_room(found, samples, basis, room)
        model = LightModel(basis=basis @ room.mT, normals=normals, points=points)
        found = fit_lights(model, samples, iterations, (found.lights, found.albedo))
    return found, room


@torch.no_grad()
def _fit_room(
    found: LightFit,
    samples: ImageSamples,
    basis: Float[Tensor, "sample 9"],
    room: Float[Tensor, "1 9"],
) -> Float[Tensor, "1 9"]:
    """Take a Gauss-Newton step of the room's harmonics and the albedos, all else fixed."""
    albedo, ambient = found.albedo, found.lights[:, 0]
    shading = found.model.shade(found.lights)
    residual = samples.residual(albedo, shading)
    weight = samples.weights(residual, samples.scale(residual))
    slope = basis[:, 1:] * albedo[:, None]
    own = (weight * shading**2).sum(dim=1).clamp_min(1e-300)
    cross = slope * ((weight * shading) @ ambient)[:, None]
    whole = slope.mT @ (slope * (weight @ ambient**2)[:, None])
    matrix = whole - cross.mT @ (cross / own[:, None])
    side = slope.mT @ ((weight * residual) @ ambient)
    side = side - cross.mT @ ((weight * residual * shading).sum(dim=1) / own)
    # Under one light for all views the albedo explains the room, and the matrix is rounding alone:
    # 1e-16 of what was subtracted.
    floor = torch.maximum(1e-6 * matrix.diagonal().mean(), 1e-12 * whole.diagonal().mean())
    step = torch.linalg.solve(matrix + floor.clamp_min(1e-300) * torch.eye(8).to(matrix), side)
    return room + pad(step, (1, 0))


@torch.no_grad()
def _selected(
    samples: ImageSamples, normals: SampleVectors, points: SampleVectors, iterations: int
) -> str:
    """Select the model by its residuals where radiance is left out of the fit."""
    few = slice(None, None, -(-len(normals) // 2500))
    normals, points = normals[few], points[few]
    every = samples.at(few)
    test = light_models.left_out(every.seen)
    seen = every.seen & ~test
    rest = ImageSamples(radiance=torch.where(seen, every.radiance, 0), seen=seen)
    best, least = "", torch.empty(0)
    for name in _MODELS:
        misfit = _fit(name, rest, normals, points, iterations)[0].misfit(every, test)
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
