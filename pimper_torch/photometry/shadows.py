"""Cast shadows: what the point light of a view reaches, from light and surface."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import max_pool2d, normalize

from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.photometry.light_field import LightField
from pimper_torch.records import Record

# Rays round a sample that look for an edge of a shadow near it.
_RING = 6

# Rays that are cast together; bounds memory to about 100 MB.
_RAYS_AT_ONCE = 1_000_000


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Shadows(Record):
    """What point lights reach.

    Attributes:
        lit: True where nothing stands between the point light and the surface, which faces it;
            true everywhere in a view without a point light.
        sure: True where no edge of a cast shadow is nearer than the guard.
    """

    lit: Bool[Tensor, "*batch view"]
    sure: Bool[Tensor, "*batch view"]


def cast_shadows(
    field: LightField,
    caster: RayCaster,
    points: Float[Tensor, "*batch 3"],
    normals: Float[Tensor, "*batch 3"],
    tolerance: float | Float[Tensor, "*#batch"],
    guard: float | Float[Tensor, "*#batch"] = 0.0,
    asked: Bool[Tensor, "*batch view"] | None = None,
) -> Shadows:
    """Cast a ray from every sample to the point light of every view.

    Args:
        field: Point lights.
        caster: The surface that casts the shadows.
        points: World; on that surface or near it.
        normals: Unit, outward.
        tolerance: How far points may lie off the surface, scene units: rays start so far
            along the normal, and as far again towards the point light. A body thinner than that
            casts no shadow on what it touches.
        guard: How far, along the surface, the edge of a cast shadow may lie from where it is
            predicted; scene units. Above 0, six rays more are cast round each lit or shadowed
            sample that faces the point light, and one that disagrees makes it unsure: no straight
            edge that near is missed.
        asked: Where an answer is wanted; elsewhere everything is lit and sure.

    Returns:
        A sample that can be trusted to be lit is ``lit & sure``. What faces away from the point
        light lies in attached shadow: not lit, and sure.

    A constant to autograd. Ray casting is float32 on the CPU.
    """
    shape, like = points.shape[:-1], points
    flat, up = points.detach().reshape(-1, 3), normals.detach().reshape(-1, 3)
    slack = torch.as_tensor(tolerance).to(like).expand(shape).reshape(-1)
    margin = torch.as_tensor(guard).to(like).expand(shape).reshape(-1)
    ring = _ring(up, margin) if bool((margin > 0).any()) else None
    views = len(field.point_light)
    lit = torch.ones(len(flat), views, dtype=torch.bool, device=like.device)
    sure = torch.ones_like(lit)
    shines = field.point_light.norm(dim=1) > 0
    wanted = lit & shines if asked is None else asked.reshape(-1, views) & shines
    at_once = max(1, _RAYS_AT_ONCE // (1 if ring is None else 1 + _RING))
    for some in torch.split(wanted.mT.nonzero(), at_once):
        view, sample = some.unbind(dim=1)
        towards, _ = _direction_to_light(field, view, flat[sample])
        facing = (towards * up[sample]).sum(dim=-1) > 0
        lit[sample, view] = facing
        view, sample = view[facing], sample[facing]
        free = _free(field, view, caster, flat[sample], up[sample], slack[sample])
        lit[sample, view] = free
        if ring is not None:
            around = flat[sample, None] + ring[sample]
            outward = up[sample, None].expand_as(around)
            same = _free(field, view[:, None], caster, around, outward, slack[sample, None])
            sure[sample, view] = (same == free[:, None]).all(dim=1)
    return Shadows(lit=lit.reshape(*shape, views), sure=sure.reshape(*shape, views))


def cast_shadows_on_rasters(
    field: LightField,
    caster: RayCaster,
    points: Float[Tensor, "patch height width 3"],
    normals: Float[Tensor, "patch height width 3"],
    spacing: Float[Tensor, " patch"],
    *,
    tolerance: float | Float[Tensor, " patch"],
    guard: float = 0.0,
    stride: int = 4,
    asked: Bool[Tensor, "patch height width"] | None = None,
    seen: Bool[Tensor, "patch view height width"] | None = None,
) -> Shadows:
    """Predict shadows on templates from a sparse raster of rays.

    See :func:`cast_shadows`. A sample that no ray was cast for takes the answer of the nearest
    one that was; with a guard, the way between the two is added to it.

    Args:
        field: Point lights.
        caster: The surface that casts the shadows.
        points: World, of every sample.
        normals: World, unit, outward.
        spacing: Of the samples, scene units.
        tolerance: Scene units.
        guard: Scene units.
        stride: Samples between rays.
        asked: Where an answer is wanted; elsewhere everything is lit and sure.
        seen: In which views; no answer is wanted in others.

    Returns:
        Of shape ``patch height width view``.
    """
    height, width = points.shape[1:3]
    rows, columns = _ray_places(height, stride, points), _ray_places(width, stride, points)
    wanted = points.new_ones(points.shape[:3], dtype=torch.bool) if asked is None else asked
    chosen = _in_blocks(wanted[:, None], stride)[:, 0]
    views = None if seen is None else _in_blocks(seen, stride).movedim(1, -1)[chosen]
    patch, row, column = chosen.nonzero(as_tuple=True)
    place = patch, rows[row], columns[column]
    slack = torch.as_tensor(tolerance).to(points).expand(len(points))
    margin = guard + 2**0.5 * (stride // 2) * spacing if guard > 0 else torch.zeros_like(spacing)
    found = cast_shadows(
        field, caster, points[place], normals[place], slack[patch], margin[patch], views
    )

    def spread_out(sparse: Bool[Tensor, "ray view"]) -> Bool[Tensor, "patch height width view"]:
        blocks = torch.ones(*chosen.shape, sparse.shape[1], dtype=torch.bool, device=sparse.device)
        blocks[chosen] = sparse
        dense = blocks.repeat_interleave(stride, dim=1).repeat_interleave(stride, dim=2)
        return dense[:, :height, :width]

    return Shadows(lit=spread_out(found.lit), sure=spread_out(found.sure))


def _in_blocks(
    some: Bool[Tensor, "patch view height width"], stride: int
) -> Bool[Tensor, "patch view rows columns"]:
    """Tell which blocks of ``stride`` samples have any of some."""
    return max_pool2d(some.float(), stride, ceil_mode=True) > 0


def _ray_places(size: int, stride: int, like: Float[Tensor, "..."]) -> Int[Tensor, " ray"]:
    """Give the sample in each block of ``stride`` that the ray is cast from."""
    first = torch.arange(0, size, stride, device=like.device)
    return (first + stride // 2).clamp_max(size - 1)


def _direction_to_light(
    field: LightField, view: Int[Tensor, "*#batch"], points: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch"]]:
    """Give the unit direction to the point light and its distance, infinite for one far away."""
    direction = normalize(field.point_light, dim=1).to(points)[view]
    closeness = field.closeness.to(points)[view]
    away = direction - closeness[..., None] * (points - field.origin.to(points))
    length = away.norm(dim=-1)
    far = torch.where(closeness > 0, length / closeness.clamp_min(1e-30), torch.inf)
    return away / length.clamp_min(1e-30)[..., None], far


def _free(
    field: LightField,
    view: Int[Tensor, "*#batch"],
    caster: RayCaster,
    points: Float[Tensor, "*batch 3"],
    normals: Float[Tensor, "*batch 3"],
    slack: Float[Tensor, "*#batch"],
) -> Bool[Tensor, "*batch"]:
    lifted = points + slack[..., None] * normals
    towards, reach = _direction_to_light(field, view, lifted)
    return ~caster.blocked(lifted + slack[..., None] * towards, towards, reach - slack)


def _ring(
    normals: Float[Tensor, "sample 3"], radius: Float[Tensor, " sample"]
) -> Float[Tensor, "sample ring 3"]:
    """Give steps in the tangent plane, on a hexagon outside the circle of that radius."""
    # The axis that is least along the normal: their cross product does not vanish.
    axis = torch.eye(3).to(normals)[normals.abs().argmin(dim=1)]
    one = normalize(torch.linalg.cross(axis, normals), dim=1)
    other = torch.linalg.cross(normals, one)
    rotation = 2 * math.pi * torch.arange(_RING).to(normals) / _RING
    reach = radius[:, None, None] / math.cos(math.pi / _RING)
    return reach * (
        rotation.cos()[:, None] * one[:, None] + rotation.sin()[:, None] * other[:, None]
    )
