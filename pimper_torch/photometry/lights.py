r"""The light of every view, from normals that are already known.

The coarse mesh knows the shape to a few degrees; that is enough to calibrate lights, and
lights that are calibrated leave no ambiguity for the factorization.

Two models are fitted, and the one that explains the photographs better is taken: soft light,
the same first-order harmonics all over the scene; and a point light at some place, whose light
falls off, with attached shadows and an ambient term. One light for all, linear in
:math:`(1, n)`, is no model for a point light: its falling off and its shadows are taken for shape.
"""

import math
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.geometry.frames import invert_rigid, transform
from pimper_torch.photometry.harmonics import harmonics
from pimper_torch.photometry.light_field import LightField
from pimper_torch.photometry.light_fit import fit_lights, with_gradients
from pimper_torch.photometry.light_models import PointLight, SoftLight
from pimper_torch.photometry.shown import Shown
from pimper_torch.records import PatchSet, PatchViews, Templates

# A point light has one number more than soft light, and must leave smaller residuals than this
# fraction.
_POINT_LIGHT_GAIN = 0.95

# Light is fitted to this many samples at most; more would only repeat them.
LIGHT_SAMPLES = 10_000

# Thinned templates keep so many times as many samples on their facets: what no view shows is among
# them.
_SPARE = 2


def thinned(patches: PatchSet) -> PatchSet:
    """Keep every so many samples of each template, enough to fit the light to.

    Light can so be fitted before all views are resampled on all templates. All patches keep some:
    lights fitted to as many samples of every seventh patch alone were 1.3 degrees off in the
    median view of the skull, those fitted to samples of all patches 0.2.

    Returns:
        Templates with fewer rows and columns, the samples where they were.
    """
    own = sum(int((each.barycentric >= 0).all(dim=-1).sum()) for each in patches.buckets)
    step = max(1, math.isqrt(own // (_SPARE * LIGHT_SAMPLES)))
    return patches.replace(buckets=tuple(_every(each, step) for each in patches.buckets))


def light_of_mesh(
    seen: PatchViews,
    coarse: list[Float[Tensor, "_ _ _ 3"]],
    min_views: int,
    model: Literal["auto", "soft", "point_light"],
) -> LightField:
    """Fit the light field to samples spread evenly over the facets themselves.

    Args:
        seen: All views on all templates, :func:`thinned` or not.
        coarse: Normals of what the templates carry, bucket by bucket, patch frame.
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
    for templates, registered, blend, these in zip(
        seen.patches.buckets, seen.buckets, coarse, chosen, strict=True
    ):
        patch, row, column = (part[::stride] for part in these.nonzero(as_tuple=True))
        gray = registered.radiance[patch, :, :, row, column].mean(dim=2)
        finite = gray.isfinite()
        radiance.append(torch.where(finite, gray, 0))
        visible.append(registered.valid[patch, :, row, column] & finite)
        to_world = templates.patch_from_world[patch, :3, :3].to(blend)
        normals.append((blend[patch, row, column, None] @ to_world)[:, 0])
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
    r"""Fit soft light or point lights, or both, and take what leaves the smaller residuals.

    Minimised is :math:`\sum_{ig} \phi(x_{gi} - \rho_i\, s_g(i))`, :math:`\phi` being Cauchy's
    loss with a scale of 2.385 spreads of the view's residuals (wider at first).

    Args:
        radiance: Gray, linear. Entries that are not seen do not matter.
        seen: False where missing.
        normals: Unit, world.
        points: World; without, point lights are far away.
        model: Which to fit; ``auto`` is both.
        iterations: At most, for each model.

    Returns:
        The scale between light and albedo is free; here the median of ``|l|`` over the views,
        at the centre of the points, is 1. A view without data has zero.

    Fails where the normals span too little (a plane shows one number of each soft light): the
    answer is then the smallest change from lights that shine along the mean normal, and
    lights that differ are found parallel. Computed in float64. Differentiable by the implicit
    function; which model is taken, and what is held at a bound, is constant.

    Source: of the point light, Queau et al., LED-based photometric stereo, JMIV 60, 2018; that it
        is
    calibrated by the coarse shape is ours.
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
    shown = Shown(radiance=torch.where(seen, radiance[some], 0).double(), seen=seen)
    known = normals[some].double()
    positions = torch.zeros_like(known) if points is None else points[some].double()
    origin = positions.mean(dim=0)
    size = _extent(positions - origin)
    soft = point_light = None
    if model != "point_light":
        soft = fit_lights(SoftLight(basis=harmonics(known)), shown, iterations)
    if model != "soft":
        point_light = fit_lights(
            PointLight(normals=known, points=(positions - origin) / size), shown, iterations
        )
    lights = torch.zeros(views, 4).to(shown.radiance)
    point_lights, closeness = torch.zeros_like(lights[:, 1:]), torch.zeros_like(lights[:, 0])
    if point_light is None or (
        soft is not None and point_light.misfit >= _POINT_LIGHT_GAIN * soft.misfit
    ):
        assert soft is not None
        lights = with_gradients(soft, shown).lights
    else:
        solution = with_gradients(point_light, shown).lights
        lights = torch.cat([solution[:, :1], lights[:, 1:]], dim=1)
        point_lights = solution[:, 1:4]
        closeness = torch.zeros_like(closeness) if points is None else solution[:, 4] / size
    factor = _typical(lights.square().sum(dim=1) + point_lights.square().sum(dim=1))
    return LightField(
        origin=origin.to(radiance),
        soft=(lights / factor).to(radiance),
        point_light=(point_lights / factor).to(radiance),
        closeness=closeness.to(radiance),
    )


def _extent(positions: Float[Tensor, "sample 3"]) -> Float[Tensor, ""]:
    """Give the mean distance of places from their centre, 1 if all are one."""
    offsets = positions[(positions != 0).any(dim=1)]
    return offsets.norm(dim=1).sum() / len(positions) if len(offsets) else positions.new_ones(())


def _typical(square: Float[Tensor, " view"]) -> Float[Tensor, ""]:
    """Give the median length of lights, from the squares of those that shine."""
    shining = square[square > 0]
    return shining.sqrt().median() if len(shining) else square.new_ones(())


def _every(templates: Templates, step: int) -> Templates:
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
