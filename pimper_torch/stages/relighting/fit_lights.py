"""Ambient and directed light of every photograph, fitted with the surface held fixed.

A photograph's exposure and colour are part of its light. Radiance is linear in the ambient and
directed strengths of each channel, so only the direction is searched: over the sphere without cast
shadows, then among the best with them, then in decreasing steps. Residuals are of sRGB values with
Cauchy's loss, so that highlights and shadows of other objects have little weight.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize, pad

from pimper_torch.geometry.directions import even_directions
from pimper_torch.geometry.pixels import scale_intrinsics
from pimper_torch.linalg.robust import CAUCHY_TUNING, cauchy_weights, median_deviation
from pimper_torch.radiometry import SATURATED
from pimper_torch.records import Materials, Record, Silhouettes, SparseScene, ViewLights
from pimper_torch.records.shapes import Vertices
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.stages.relighting.lit_surface import (
    LitSurface,
    SurfacePixels,
    diffuse_color,
    response,
)

# Maximum length of the longer side of the photographs used: some 20,000 pixels of an object, ten
# thousand times the unknowns of a light.
_SIZE_PX = 300

# Below this radiance the weight of an error is constant: with the slope of sRGB, noise would
# dominate.
_DARK = 0.01


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Observed(Record):
    """The pixels of a photograph that show a surface.

    Attributes:
        weight: Of a squared error of radiance, so that errors are those of sRGB.
        saturated: True where the photograph is saturated, at least in part of the pixel: the
            radiance there is a lower bound.
    """

    pixels: SurfacePixels
    radiance: Float[Tensor, "pixel channel"]
    weight: Float[Tensor, "pixel channel"]
    saturated: Bool[Tensor, " pixel"]

    def thinned(self, most: int) -> "Observed":
        """Keep every n-th pixel, so that at most ``most`` are left."""
        step = -(-len(self.radiance) // most)
        return self.take(slice(None, None, step)) if step > 1 else self


def observe_all(
    surface: LitSurface, scene: SparseScene, silhouettes: Silhouettes | None
) -> list[Observed]:
    """Return the pixels of every photograph that show only the surface.

    Args:
        silhouettes: Of all views; by default the views' masks, or the surface's outline.
    """
    masks = scene.views.masks

    def observed(view: int) -> Observed:
        camera = scene.cameras.take([view])
        width, height = camera.sizes_px[0].tolist()
        factor = max(1, -(-max(width, height) // _SIZE_PX))
        intrinsics = scale_intrinsics(camera.intrinsics, 1 / factor, 1 / factor)
        smaller = camera.replace(intrinsics=intrinsics, sizes_px=camera.sizes_px // factor)
        pixels = surface.pixels(smaller)
        image = scene.views.images[view, :, :height, :width].detach().cpu().float()
        radiance = avg_pool2d(image, factor).flatten(1).mT
        saturated = avg_pool2d((image.amax(dim=0, keepdim=True) >= SATURATED).float(), factor)
        kept = pixels.inner & radiance[pixels.pixel].isfinite().all(dim=1)
        mask = None if masks is None else masks[view]
        if silhouettes is not None:
            mask = silhouettes.inside[view] > 0.5
        if mask is not None:
            inside = avg_pool2d(mask[None, :height, :width].cpu().float(), factor)
            kept &= inside.flatten()[pixels.pixel] > 0.99
        pixels = pixels.take(kept)
        radiance = radiance[pixels.pixel].clamp(0, 1)
        # The squared slope of sRGB up to a factor.
        return Observed(
            pixels=pixels,
            radiance=radiance,
            weight=radiance.clamp_min(_DARK) ** (2 / 2.4 - 2),
            saturated=saturated.flatten()[pixels.pixel] > 0,
        )

    return list(side_by_side(observed, range(scene.cameras.num_views), tracked=False))


def loss_scale(seen: Observed) -> float:
    """Return the scale of Cauchy's loss from a first-order light without shadows."""
    basis = torch.cat([torch.ones_like(seen.radiance[:, :1]), seen.pixels.normals_world], dim=1)
    root = seen.weight.sqrt() * ~seen.saturated[:, None]
    rows = (root * seen.pixels.base_color).mT[..., None] * basis
    values = (root * seen.radiance).mT[..., None]
    light = torch.linalg.lstsq(rows, values, driver="gelsd").solution
    size = (values - rows @ light)[..., 0].norm(dim=0)
    deviation = float(median_deviation(size, torch.ones_like(size, dtype=torch.bool)))
    # Half a step of eight bits.
    return CAUCHY_TUNING * max(deviation, 0.002)


def fit_strengths(
    seen: Observed,
    diffuse: Float[Tensor, "*batch pixel #channel"],
    response: Float[Tensor, "light pixel #channel"],
    scale: float,
) -> tuple[Float[Tensor, "light channel"], Float[Tensor, "light channel"], Float[Tensor, " light"]]:
    """Fit ambient and directed strengths of every light by iteratively reweighted least squares.

    Args:
        diffuse: Radiance under an ambient light of 1, one for all lights or one for each.
        response: Radiance under a directed light of strength 1.

    Returns:
        Ambient and directed strengths, neither below 0, and the mean loss.
    """
    radiance = seen.radiance
    used = (~seen.saturated)[:, None].expand_as(response).float()
    robust = torch.ones_like(response[..., 0])
    for _ in range(3):
        weight = robust[..., None] * seen.weight * used
        aa, ab = (weight * diffuse**2).sum(dim=1), (weight * diffuse * response).sum(dim=1)
        bb = (weight * response**2).sum(dim=1)
        ay = (weight * diffuse * radiance).sum(dim=1)
        by = (weight * response * radiance).sum(dim=1)
        ambient, directed = _non_negative(aa, ab, bb, ay, by)
        error = ambient[:, None] * diffuse + directed[:, None] * response - radiance
        # A saturated photograph bounds the radiance from below.
        error = torch.where(seen.saturated[:, None], error.clamp_max(0), error)
        used = (error != 0).float()
        size = (seen.weight * error**2).sum(dim=-1).sqrt()
        robust = cauchy_weights(size, torch.full_like(size[:1, :1], scale))
    return ambient, directed, -robust.log().mean(dim=1)


def _non_negative(
    aa: Tensor, ab: Tensor, bb: Tensor, ay: Tensor, by: Tensor
) -> tuple[Tensor, Tensor]:
    """Solve the normal equations of two unknowns with neither below 0."""
    tiny = torch.finfo(aa.dtype).tiny
    determinant = aa * bb - ab**2
    sound = determinant > 1e-6 * aa * bb
    determinant = torch.where(sound, determinant, 1)
    first, second = (bb * ay - ab * by) / determinant, (aa * by - ab * ay) / determinant
    alone, other = ay / aa.clamp_min(tiny), by / bb.clamp_min(tiny)
    interior = sound & (first >= 0) & (second >= 0)
    # At the constrained optimum one of them is 0: the larger decrease of the cost decides which.
    larger = ay * alone >= by * other
    return (
        torch.where(interior, first, torch.where(larger, alone, 0)),
        torch.where(interior, second, torch.where(larger, 0, other)),
    )


# Number of directions tried first, some 12 degrees apart, and number refined with cast shadows.
_DIRECTIONS, _CANDIDATES = 300, 12
# Numbers of pixels of a photograph used for the first directions, and for the last.
_FEW, _MANY = 500, 2000
# First and maximum values of radius over distance: as for a lamp held near the object.
_INVERSE_DISTANCES, _MAX_INVERSE_DISTANCE = (0.0, 0.25, 0.5), 0.7
# Steps of direction, in radians, and of inverse distance: from half the distance of the first
# directions down to a tenth of a degree.
_COARSE, _FINE = (0.1, 0.1, 0.05, 0.05, 0.025, 0.025), (0.04, 0.02, 0.01, 0.005, 0.0025)


def lights_of(
    surface: LitSurface,
    observed: Sequence[Observed],
    materials: Materials | None = None,
    start: ViewLights | None = None,
) -> ViewLights:
    """Fit the light of every photograph.

    Args:
        observed: Of each photograph, see :func:`observe_all`.
        start: Approximate lights; by default the complete sphere is searched.
    """
    material = None if materials is None else materials.at_vertices()

    def fit(view: int) -> ViewLights:
        near = None if start is None else start.take([view])
        return _fit(surface, observed[view], material, near)

    return ViewLights.cat(list(side_by_side(fit, range(len(observed)), tracked=False)))


def _fit(
    surface: LitSurface, seen: Observed, material: Vertices | None, start: ViewLights | None
) -> ViewLights:
    if len(seen.radiance) == 0:
        up, zero = torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1, seen.radiance.shape[1])
        return ViewLights(
            direction_world=up, inverse_distance=zero[:, 0], ambient=zero, directed=zero
        )
    few, many = seen.thinned(_FEW), seen.thinned(_MANY)
    scale = loss_scale(few)

    def rendered(
        seen: Observed, lights: Float[Tensor, "light 4"], shadows: bool = True
    ) -> tuple[Float[Tensor, "pixel channel"], Float[Tensor, "light pixel channel"]]:
        values = None if material is None else material[seen.pixels.vertex]
        light = surface.incidence(seen.pixels, lights[:, :3], lights[:, 3], shadows=shadows)
        return diffuse_color(seen.pixels, values), response(seen.pixels, light, values)

    def best(
        seen: Observed, lights: Float[Tensor, "start light 4"], shadows: bool = True, most: int = 1
    ) -> Float[Tensor, "start most 4"]:
        """Return the best lights of every start, best first."""
        losses = fit_strengths(seen, *rendered(seen, lights.flatten(0, 1), shadows), scale)[2]
        order = losses.reshape(lights.shape[:2]).argsort(dim=1, stable=True)[:, :most]
        return lights.gather(1, order[..., None].expand(-1, -1, 4))

    lights = pad(even_directions(_DIRECTIONS).float(), (0, 1))
    if start is not None:
        lights = torch.cat([start.direction_world, start.inverse_distance[:, None]], dim=1)
    else:
        far = best(few, lights[None], shadows=False, most=_CANDIDATES)[0]
        tried = [pad(far[:, :3], (0, 1), value=inverse) for inverse in _INVERSE_DISTANCES]
        starts = best(few, torch.stack(tried))
        for step in _COARSE:
            starts = best(few, torch.stack([_neighbours(light[0], step) for light in starts]))
        lights = best(many, starts.flatten(0, 1)[None])[0]
    for step in _FINE:
        lights = best(many, _neighbours(lights[0], step)[None])[0]
    ambient, directed, _ = fit_strengths(many, *rendered(many, lights[:1]), scale)
    return ViewLights(
        direction_world=lights[:1, :3],
        inverse_distance=lights[:1, 3],
        ambient=ambient,
        directed=directed,
    )


def _neighbours(light: Float[Tensor, " 4"], step: float) -> Float[Tensor, "11 4"]:
    """Return a light and its neighbours: ``step`` radians away, nearer and farther."""
    direction = light[:3]
    axis = torch.eye(3).to(direction)[direction.abs().argmin()]
    first = normalize(torch.linalg.cross(direction, axis), dim=0)
    second = torch.linalg.cross(direction, first)
    angle = torch.arange(8, dtype=direction.dtype) * (torch.pi / 4)
    around = angle.cos()[:, None] * first + angle.sin()[:, None] * second
    directions = torch.cat([direction[None], normalize(direction + step * around, dim=1)])
    directions = torch.cat([directions, light[3].expand(9, 1)], dim=1)
    along = light.repeat(2, 1)
    along[:, 3] = (light[3] + torch.tensor([-step, step])).clamp(0, _MAX_INVERSE_DISTANCE)
    return torch.cat([directions, along])
