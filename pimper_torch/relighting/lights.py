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
from torch.nn.functional import normalize

from pimper_torch.geometry.directions import even_directions
from pimper_torch.parallel import side_by_side
from pimper_torch.photometry.robust import CAUCHY_TUNING, cauchy_weights, median_deviation
from pimper_torch.records import Mesh, Record, Silhouettes, SparseScene
from pimper_torch.relighting.materials import Materials
from pimper_torch.relighting.observed import Observed, observe
from pimper_torch.relighting.reflectance import response
from pimper_torch.relighting.surface_pixels import LitSurface

# Directions that are tried first, some 12 degrees apart, and how many of them with cast shadows.
_DIRECTIONS, _CANDIDATES = 300, 12
# Pixels of a photograph that the first directions are tried on, and the last.
_FEW, _MANY = 500, 3000
# Radians of the steps: half the distance of the first directions, down to a tenth of a degree.
_STEPS = tuple(0.1 / 2**halving for halving in range(7))
_REWEIGHTED = 3


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class ViewLights(Record):
    """The light of every view, for base colours of :func:`~pimper_torch.viz.maps.base_color`.

    Attributes:
        direction_world: Unit, towards the light.
        ambient: Radiance of a white matte surface in shadow.
        directed: Added where it faces the light.
    """

    direction_world: Float[Tensor, "view 3"]
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
    views = range(scene.cameras.num_views)
    observed = list(side_by_side(lambda view: observe(surface, scene, view, silhouettes), views))
    return lights_of(surface, observed, materials)


def lights_of(
    surface: LitSurface, observed: Sequence[Observed], materials: Materials | None = None
) -> ViewLights:
    """Fit the light of every photograph; see :func:`fit_lights`."""
    material = None if materials is None else materials.at_vertices()
    fits = list(side_by_side(lambda seen: _fit(surface, seen, material), observed))
    direction, ambient, directed = (torch.stack(part) for part in zip(*fits, strict=True))
    return ViewLights(direction_world=direction, ambient=ambient, directed=directed)


# Ambient and directed strengths of every direction and channel, and the mean loss.
Strengths = tuple[
    Float[Tensor, "direction channel"],
    Float[Tensor, "direction channel"],
    Float[Tensor, " direction"],
]


def _fit(
    surface: LitSurface, seen: Observed, material: Float[Tensor, "vertex 3"] | None
) -> tuple[Float[Tensor, " 3"], Float[Tensor, " channel"], Float[Tensor, " channel"]]:
    """Fit direction, ambient and directed strength of one photograph."""
    usable = seen.take((seen.weight > 0).all(dim=1))
    few, many = usable.thinned(_FEW), usable.thinned(_MANY)
    directions = even_directions(_DIRECTIONS).float()
    if len(few.radiance) == 0:
        return directions[0], *torch.zeros(2, seen.radiance.shape[1])
    scale = _scale(few)

    def losses(
        directions: Float[Tensor, "direction 3"], seen: Observed, *, shadows: bool = True
    ) -> Strengths:
        cosine = surface.cosines(seen.pixels, directions, shadows=shadows)
        own = None if material is None else material[seen.pixels.vertex]
        return _strengths(seen, response(seen.pixels, directions, cosine, own), scale)

    loss = losses(directions, few, shadows=False)[2]
    candidates = directions[loss.argsort(stable=True)[:_CANDIDATES]]
    best = candidates[losses(candidates, few)[2].argmin()]
    for step in _STEPS:
        around = torch.cat([best[None], _ring(best, step)])
        best = around[losses(around, many)[2].argmin()]
    ambient, directed, _ = losses(best[None], many)
    return best, ambient[0], directed[0]


def _scale(seen: Observed) -> float:
    """Return the scale of Cauchy's loss, by a light of first order without any shadow."""
    basis = torch.cat([torch.ones_like(seen.radiance[:, :1]), seen.pixels.normals_world], dim=1)
    root = seen.weight.sqrt()
    residuals = []
    for channel in range(seen.radiance.shape[1]):
        rows = (root * seen.pixels.base_color)[:, channel, None] * basis
        values = (root * seen.radiance)[:, channel]
        light = torch.linalg.lstsq(rows, values[:, None], driver="gelsd").solution[:, 0]
        residuals.append(values - rows @ light)
    size = torch.stack(residuals).norm(dim=0)
    deviation = float(median_deviation(size, torch.ones_like(size, dtype=torch.bool)))
    return CAUCHY_TUNING * max(deviation, 1e-4)


def _strengths(
    seen: Observed, response: Float[Tensor, "direction pixel channel"], scale: float
) -> Strengths:
    """Fit ambient and directed strength for every direction, by reweighted least squares.

    Returns:
        Both, neither below 0, and the mean loss.
    """
    base, radiance = seen.pixels.base_color, seen.radiance
    robust = torch.ones_like(response[..., 0])
    for _ in range(_REWEIGHTED):
        weight = robust[..., None] * seen.weight
        aa, ab = (weight * base**2).sum(dim=1), (weight * base * response).sum(dim=1)
        bb = (weight * response**2).sum(dim=1)
        ay = (weight * base * radiance).sum(dim=1)
        by = (weight * response * radiance).sum(dim=1)
        ambient, directed = _non_negative(aa, ab, bb, ay, by)
        error = ambient[:, None] * base + directed[:, None] * response - radiance
        size = (seen.weight * error**2).sum(dim=-1).sqrt()
        robust = cauchy_weights(size, torch.full_like(size[:1, :1], scale))
    return ambient, directed, -robust.log().mean(dim=1)


def _non_negative(
    aa: Tensor, ab: Tensor, bb: Tensor, ay: Tensor, by: Tensor
) -> tuple[Tensor, Tensor]:
    """Solve the normal equations of two unknowns, neither below 0."""
    tiny = torch.finfo(aa.dtype).tiny
    determinant = aa * bb - ab**2
    sound = determinant > 1e-6 * aa * bb
    determinant = torch.where(sound, determinant, 1)
    first, second = (bb * ay - ab * by) / determinant, (aa * by - ab * ay) / determinant
    alone, other = ay / aa.clamp_min(tiny), by / bb.clamp_min(tiny)
    both = sound & (first >= 0) & (second >= 0)
    # One of them is 0 at the best point that is allowed: the gain of each alone decides.
    larger = ay * alone >= by * other
    return (
        torch.where(both, first, torch.where(larger, alone, 0)),
        torch.where(both, second, torch.where(larger, 0, other)),
    )


def _ring(direction: Float[Tensor, " 3"], step: float) -> Float[Tensor, "8 3"]:
    """Return directions round one, ``step`` radians from it."""
    axis = torch.eye(3).to(direction)[direction.abs().argmin()]
    first = normalize(torch.linalg.cross(direction, axis), dim=0)
    second = torch.linalg.cross(direction, first)
    angle = torch.arange(8, dtype=direction.dtype) * (torch.pi / 4)
    around = angle.cos()[:, None] * first + angle.sin()[:, None] * second
    return normalize(direction + step * around, dim=1)
