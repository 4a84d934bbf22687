"""Where every view's point light may be: a search over directions, before any descent.

What a point light lights and what it leaves in shadow makes the fit of its direction a problem with
many
minima: a descent from point lights that shine along the mean normal ended 30 to 70 degrees beside
the point light in six of nine views of a potato on a table, with twice the residuals.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.geometry.directions import even_directions
from pimper_torch.photometry.shown import Shown

# Directions that are tried, 10 degrees apart, at so many samples at most; and rounds, in which
# samples in cast shadow lose weight and albedo settles: none changed after the third.
_DIRECTIONS, _SAMPLES, _ITERATIONS = 400, 2000, 3

# Of a sample's radiance over the views: it is lit in more than this fraction of them.
_LIT_QUANTILE = 0.8

# Directions whose costs differ by less than this fraction of what is shown are alike: the one next
# to the mean normal is taken, as where the samples lie in a plane. And a point light that is weaker
# than this fraction of the ambient light is none: then albedo explains all, and any point light
# would do.
_ALIKE = 1e-3

# Ambient light where any point light would do, over the point light's.
_AMBIENT = 0.2


def search_point_lights(
    shown: Shown, normals: Float[Tensor, "sample 3"]
) -> tuple[Float[Tensor, "view 4"], Float[Tensor, " sample"]]:
    r"""Search the direction of each view's point light, taken to be far away.

    With albedo given, from what samples show where they are brightest, ambient light :math:`a`
    and a point light's strength :math:`s` follow for every direction :math:`d` in closed form from
    :math:`\sum_i w_i (x_i - \rho_i (a + s \max(0, n_i \cdot d)))^2`, and the direction that
    leaves least is taken; then weights and albedo, in turn.

    Args:
        shown: Radiance of the samples.
        normals: Unit, world.

    Returns:
        Ambient light and the point light's irradiance vector, one of each a view, neither negative;
        and the samples' albedo. A constant to autograd.
    """
    stride = -(-len(normals) // _SAMPLES)
    some = Shown(radiance=shown.radiance[::stride], seen=shown.seen[::stride])
    directions = even_directions(_DIRECTIONS).to(normals)
    facing = (normals[::stride] @ directions.mT).clamp_min(0)
    mean = normals.mean(dim=0)
    ahead = mean / mean.norm().clamp_min(1e-12)
    aside = _ALIKE * (1 - directions @ ahead)
    missing = torch.where(some.seen, some.radiance, torch.nan)
    albedo = missing.nanquantile(_LIT_QUANTILE, dim=1).nan_to_num(nan=0.0)
    weight = some.seen.to(normals)
    for _ in range(_ITERATIONS):
        ambient, strength, left = _explained(some, albedo, facing, weight)
        power = (weight * some.radiance**2).sum(dim=0)[:, None]
        best = (left + power * aside).argmin(dim=1, keepdim=True)
        ambient, strength = ambient.gather(1, best)[:, 0], strength.gather(1, best)[:, 0]
        shading = ambient + strength * facing[:, best[:, 0]]
        residual = some.residual(albedo, shading)
        weight = some.weights(residual, some.scale(residual))
        albedo = some.albedo_under(shading, weight).nan_to_num(nan=0.0)
    point_light = strength[:, None] * directions[best[:, 0]]
    none = strength <= _ALIKE * ambient
    point_light = torch.where(none[:, None], ambient[:, None] * ahead, point_light)
    ambient = torch.where(none, _AMBIENT * ambient, ambient)
    lights = torch.cat([ambient[:, None], point_light], dim=1)
    shading = lights[:, 0] + (normals @ lights[:, 1:].mT).clamp_min(0)
    everywhere = shown.albedo_under(shading, shown.seen.to(normals))
    return lights, everywhere.nan_to_num(nan=0.0)


def _explained(
    shown: Shown,
    albedo: Float[Tensor, " sample"],
    facing: Float[Tensor, "sample direction"],
    weight: Float[Tensor, "sample view"],
) -> tuple[
    Float[Tensor, "view direction"],
    Float[Tensor, "view direction"],
    Float[Tensor, "view direction"],
]:
    """Give ambient light and strength for every direction, and the squares that they leave."""
    J = shown.radiance
    lit = albedo[:, None] * facing
    own = (weight * albedo[:, None] ** 2).sum(dim=0)[:, None]
    cross = (weight * albedo[:, None]).mT @ lit
    square = weight.mT @ lit**2
    on_ambient = (weight * J * albedo[:, None]).sum(dim=0)[:, None]
    on_light = (weight * J).mT @ lit
    tiny = torch.finfo(J.dtype).tiny
    determinant = own * square - cross**2
    known = determinant > 1e-9 * own * square
    ambient = (on_ambient * square - on_light * cross) / determinant.clamp_min(tiny)
    # Alone where both cannot be told apart, or where one would be negative.
    ambient = torch.where(known, ambient, 0).clamp_min(0)
    strength = ((on_light - ambient * cross) / square.clamp_min(tiny)).clamp_min(0)
    dark = (strength == 0) | (square <= tiny)
    strength = torch.where(dark, 0, strength)
    ambient = torch.where(dark, on_ambient / own.clamp_min(tiny), ambient)
    explained = 2 * (ambient * on_ambient + strength * on_light)
    used = ambient**2 * own + 2 * ambient * strength * cross + strength**2 * square
    return ambient, strength, (weight * J**2).sum(dim=0)[:, None] - explained + used
