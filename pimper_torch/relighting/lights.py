r"""The light of every photograph: ambient and directed, fitted with the surface held fixed.

A photograph's exposure and colour are part of its light. Radiance is linear in the ambient and the
directed strength of each channel, so that a direction's own best strengths are known at once, and
only the direction is searched: over the whole sphere without cast shadows, then among the best
with them, then in ever smaller steps. Errors count as sRGB shows them, and by Cauchy's loss, so
that highlights and shadows of what was not reconstructed decide little.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize, pad

from pimper_torch.geometry.directions import even_directions
from pimper_torch.parallel import side_by_side
from pimper_torch.records import Mesh, Record, Silhouettes, SparseScene
from pimper_torch.relighting.materials import Materials
from pimper_torch.relighting.observed import Observed, observe_all
from pimper_torch.relighting.reflectance import diffuse_color, response
from pimper_torch.relighting.strengths import fit_strengths, loss_scale
from pimper_torch.relighting.surface_pixels import LitSurface

# Directions that are tried first, some 12 degrees apart, and how many of them with cast shadows.
_DIRECTIONS, _CANDIDATES = 300, 12
# Pixels of a photograph that the first directions are tried on, and the last.
_FEW, _MANY = 500, 2000
# Radius over distance that is tried first, and at most: a light as near as a lamp is held.
_CLOSENESS, _CLOSEST = (0.0, 0.25, 0.5), 0.7
# Of direction, in radians, and of closeness: half the distance of the first directions, down to a
# tenth of a degree.
_COARSE, _FINE = (0.1, 0.1, 0.05, 0.05, 0.025, 0.025), (0.04, 0.02, 0.01, 0.005, 0.0025)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class ViewLights(Record):
    """The light of every view, for base colours of :func:`~pimper_torch.viz.maps.base_color`.

    Attributes:
        direction_world: Unit, from the surface's centre towards the light.
        closeness: The surface's radius over the light's distance from its centre, see
            :class:`~pimper_torch.relighting.surface_pixels.LitSurface`; 0 for a light at infinity.
        ambient: Radiance of a white matte surface in shadow.
        directed: Added where it faces the light, at the distance of the centre.
    """

    direction_world: Float[Tensor, "view 3"]
    closeness: Float[Tensor, " view"]
    ambient: Float[Tensor, "view channel"]
    directed: Float[Tensor, "view channel"]


def fit_lights(
    mesh: Mesh,
    scene: SparseScene,
    silhouettes: Silhouettes | None = None,
    materials: Materials | None = None,
) -> ViewLights:
    """Fit the light of every photograph of a scene.

    Args:
        mesh: In the scene's frame, with albedo.
        silhouettes: Of the scene's views; without, the mesh's outline tells where the object is.
        materials: Of the mesh; matte without.
    """
    surface = LitSurface(mesh)
    return lights_of(surface, observe_all(surface, scene, silhouettes), materials)


def lights_of(
    surface: LitSurface,
    observed: Sequence[Observed],
    materials: Materials | None = None,
    start: ViewLights | None = None,
) -> ViewLights:
    """Fit the light of every photograph; see :func:`fit_lights`.

    Args:
        start: What is near it; without, the whole sphere is searched.
    """
    material = None if materials is None else materials.at_vertices()

    def fit(view: int) -> ViewLights:
        near = None if start is None else start.take([view])
        return _fit(surface, observed[view], material, near)

    fits = side_by_side(fit, range(len(observed)), tracked=False)
    return ViewLights.cat(list(fits))


def _fit(
    surface: LitSurface,
    seen: Observed,
    material: Float[Tensor, "vertex 3"] | None,
    start: ViewLights | None,
) -> ViewLights:
    """Fit the light of one photograph."""
    if len(seen.radiance) == 0:
        none = torch.zeros(1, seen.radiance.shape[1])
        up = torch.tensor([[0.0, 0.0, 1.0]])
        return ViewLights(direction_world=up, closeness=none[:, 0], ambient=none, directed=none)
    few, many = seen.thinned(_FEW), seen.thinned(_MANY)
    scale = loss_scale(few)

    def rendered(
        seen: Observed, lights: Float[Tensor, "light 4"], shadows: bool = True
    ) -> tuple[Float[Tensor, "pixel channel"], Float[Tensor, "light pixel channel"]]:
        own = None if material is None else material[seen.pixels.vertex]
        light = surface.incidence(seen.pixels, lights[:, :3], lights[:, 3], shadows=shadows)
        return diffuse_color(seen.pixels, own), response(seen.pixels, light, own)

    def best(
        seen: Observed, lights: Float[Tensor, "start light 4"], shadows: bool = True, most: int = 1
    ) -> Float[Tensor, "start most 4"]:
        """Return the best lights of every start, best first."""
        losses = fit_strengths(seen, *rendered(seen, lights.flatten(0, 1), shadows), scale)[2]
        loss = losses.reshape(lights.shape[:2])
        order = loss.argsort(dim=1, stable=True)[:, :most]
        return lights.gather(1, order[..., None].expand(-1, -1, 4))

    lights = pad(even_directions(_DIRECTIONS).float(), (0, 1))
    if start is not None:
        lights = torch.cat([start.direction_world, start.closeness[:, None]], dim=1)
    else:
        far = best(few, lights[None], shadows=False, most=_CANDIDATES)[0]
        starts = best(few, torch.stack([_with(far, one) for one in _CLOSENESS]))
        for step in _COARSE:
            starts = best(few, torch.stack([_neighbours(one[0], step) for one in starts]))
        lights = best(many, starts.flatten(0, 1)[None])[0]
    for step in _FINE:
        lights = best(many, _neighbours(lights[0], step)[None])[0]
    ambient, directed, _ = fit_strengths(many, *rendered(many, lights[:1]), scale)
    direction_world, closeness = lights[:1, :3], lights[:1, 3]
    return ViewLights(
        direction_world=direction_world, closeness=closeness, ambient=ambient, directed=directed
    )


def _with(lights: Float[Tensor, "light 4"], closeness: float) -> Float[Tensor, "light 4"]:
    return torch.cat([lights[:, :3], torch.full_like(lights[:, 3:], closeness)], dim=1)


def _neighbours(light: Float[Tensor, " 4"], step: float) -> Float[Tensor, "11 4"]:
    """Return a light, and others round it: ``step`` radians beside it, nearer and farther."""
    direction = light[:3]
    axis = torch.eye(3).to(direction)[direction.abs().argmin()]
    first = normalize(torch.linalg.cross(direction, axis), dim=0)
    second = torch.linalg.cross(direction, first)
    angle = torch.arange(8, dtype=direction.dtype) * (torch.pi / 4)
    around = angle.cos()[:, None] * first + angle.sin()[:, None] * second
    beside = torch.cat([direction[None], normalize(direction + step * around, dim=1)])
    beside = torch.cat([beside, light[3].expand(9, 1)], dim=1)
    along = light.repeat(2, 1)
    along[:, 3] = (light[3] + torch.tensor([-step, step])).clamp(0, _CLOSEST)
    return torch.cat([beside, along])
