r"""The light of every view, calibrated by the coarse mesh's normals.

Normals of the coarse mesh are right to a few degrees; that is enough to calibrate lights, and
calibrated lights leave the factorization no ambiguity.

Two models are fitted, and the one with the smaller residuals is selected: soft light, first-order
harmonics that are constant over the scene; and a near point light with inverse-square falloff,
attached shadows and an ambient term. Falloff and shadows of a point light are not linear in
:math:`(1, n)`: fitted by soft light, they would appear as shape.
"""

import math
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.geometry.frames import invert_rigid, transform
from pimper_torch.photometry.harmonics import harmonics
from pimper_torch.photometry.image_samples import ImageSamples
from pimper_torch.photometry.light_field import LightField
from pimper_torch.photometry.light_fit import fit_lights, with_gradients
from pimper_torch.photometry.light_models import PointLight, SoftLight
from pimper_torch.records import PatchSet, PatchViews, Templates

# A point light, which has one parameter more, is selected if its residuals are below this
# fraction of those of soft light: a choice.
_POINT_LIGHT_GAIN = 0.95

# Maximum number of samples that the light is fitted to: a choice, 2,000 per parameter.
LIGHT_SAMPLES = 10_000

# Thinned templates keep this multiple of LIGHT_SAMPLES on their facets: some are in no view.
_SPARE = 2


def thinned(patches: PatchSet) -> PatchSet:
    """Subsample each template's raster, as densely as fitting the light needs.

    Light can so be fitted before all views are resampled on all templates. All patches keep some
    samples: lights fitted to as many samples of every seventh patch alone were 1.3 degrees off in
    the median view of the skull, those fitted to samples of all patches 0.2.

    Returns:
        Templates with fewer rows and columns; the samples have the same positions.
    """
    own = sum(int((each.barycentric >= 0).all(dim=-1).sum()) for each in patches.buckets)
    step = max(1, math.isqrt(own // (_SPARE * LIGHT_SAMPLES)))
    return patches.replace(buckets=tuple(_subsampled(each, step) for each in patches.buckets))


def light_of_mesh(
    seen: PatchViews,
    coarse: list[Float[Tensor, "_ _ _ 3"]],
    min_views: int,
    model: Literal["auto", "soft", "point_light"],
) -> LightField:
    """Fit the light field to samples spread evenly over the facets, without their overlap.

    Args:
        seen: All views on all templates, :func:`thinned` or not.
        coarse: Normals of each bucket's templates, patch frame.
        min_views: Views a sample must be valid in.
        model: See :func:`fit_light_field`.

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
        gray = registered.radiance[patch, :, :, row, column].mean(dim=2)
        finite = gray.isfinite()
        radiance.append(torch.where(finite, gray, 0))
        visible.append(registered.valid[patch, :, row, column] & finite)
        to_world = templates.patch_from_world[patch, :3, :3].to(bucket_normals)
        normals.append((bucket_normals[patch, row, column, None] @ to_world)[:, 0])
        positions = templates.points_patch[patch, row, column, None]
        points.append(transform(invert_rigid(templates.patch_from_world[patch]), positions)[:, 0])
    return fit_light_field(
        torch.cat(radiance),
        torch.cat(visible),
        torch.cat(normals),
        torch.cat(points),
        model=model,
    )


def fit_light_field(
    radiance: Float[Tensor, "sample view"],
    seen: Bool[Tensor, "sample view"],
    normals: Float[Tensor, "sample 3"],
    points: Float[Tensor, "sample 3"] | None = None,
    model: Literal["auto", "soft", "point_light"] = "auto",
    iterations: int = 60,
) -> LightField:
    r"""Fit soft light, point lights, or both, and select the model with the smaller residuals.

    Minimizes :math:`\sum_{ig} \phi(x_{gi} - \rho_i\, s_g(i))`, :math:`\phi` being Cauchy's
    loss with a scale of 2.385 robust deviations of the view's residuals (wider at first).

    Args:
        radiance: Gray, linear. Entries that are not seen are ignored.
        seen: False where missing.
        normals: Unit, world.
        points: World; without them, point lights are distant.
        model: Which to fit; ``auto`` is both.
        iterations: At most, for each model.

    Returns:
        The scale between light and albedo is free; here the median of ``|l|`` over the views,
        at the centroid of the points, is 1. A view without data has zero light.

    Fails where the normals span too little (a plane determines one coefficient of each soft
    light): the result is then the smallest change from lights along the mean normal, so that all
    lights are nearly parallel. Computed in float64. Differentiable by the implicit function; the
    choice of the model, and the parameters at a bound, are constant.

    Source: of the point light, Queau et al., LED-based photometric stereo, JMIV 60, 2018; its
    calibration by the coarse shape is ours.
    """
    views = radiance.shape[1]
    if not seen.any():
        return LightField(
            origin=radiance.new_zeros(3),
            soft=radiance.new_zeros(views, 4),
            point_light=radiance.new_zeros(views, 3),
            closeness=radiance.new_zeros(views),
        )
    some = seen.any(dim=1)
    seen = seen[some]
    samples = ImageSamples(radiance=torch.where(seen, radiance[some], 0).double(), seen=seen)
    own_normals = normals[some].double()
    positions = torch.zeros_like(own_normals) if points is None else points[some].double()
    origin = positions.mean(dim=0)
    size = _mean_distance(positions - origin)
    soft = point_light = None
    if model != "point_light":
        soft = fit_lights(SoftLight(basis=harmonics(own_normals)), samples, iterations)
    if model != "soft":
        point_light = fit_lights(
            PointLight(normals=own_normals, points=(positions - origin) / size), samples, iterations
        )
    lights = torch.zeros(views, 4).to(samples.radiance)
    point_lights, closeness = torch.zeros_like(lights[:, 1:]), torch.zeros_like(lights[:, 0])
    if point_light is None or (
        soft is not None and point_light.misfit >= _POINT_LIGHT_GAIN * soft.misfit
    ):
        assert soft is not None
        lights = with_gradients(soft, samples).lights
    else:
        solution = with_gradients(point_light, samples).lights
        lights = torch.cat([solution[:, :1], lights[:, 1:]], dim=1)
        point_lights = solution[:, 1:4]
        closeness = torch.zeros_like(closeness) if points is None else solution[:, 4] / size
    factor = _median_length(lights.square().sum(dim=1) + point_lights.square().sum(dim=1))
    return LightField(
        origin=origin.to(radiance),
        soft=(lights / factor).to(radiance),
        point_light=(point_lights / factor).to(radiance),
        closeness=closeness.to(radiance),
    )


def _mean_distance(positions: Float[Tensor, "sample 3"]) -> Float[Tensor, ""]:
    """Return the mean distance of points from the origin; 1 if all are there."""
    offsets = positions[(positions != 0).any(dim=1)]
    return offsets.norm(dim=1).sum() / len(positions) if len(offsets) else positions.new_ones(())


def _median_length(square: Float[Tensor, " view"]) -> Float[Tensor, ""]:
    """Return the median length of the lights that are not zero, from their squares."""
    shining = square[square > 0]
    return shining.sqrt().median() if len(shining) else square.new_ones(())


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
