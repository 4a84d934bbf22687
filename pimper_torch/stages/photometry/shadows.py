"""Samples in the light of each view, and cast shadows by ray casting on the surface."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import max_pool2d, normalize

from pimper_torch.geometry.rigid import invert_rigid, rotate, transform
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.lighting.light_field import LightField, faces_light
from pimper_torch.records import Observations, Record, Templates
from pimper_torch.records.shapes import PatchMasks, PatchVectors, Scalars, Vectors
from pimper_torch.stages.photometry.fit_light import lights_in_patches
from pimper_torch.stages.photometry.sample_estimates import FlatSamples, flatten_samples


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Shadows(Record):
    """Visibility of point lights from the surface.

    Attributes:
        lit: True where the surface faces the point light and is not occluded;
            true everywhere in a view without a point light.
        sure: True where every edge of a cast shadow is farther away than the guard.
    """

    lit: Bool[Tensor, "*batch view"]
    sure: Bool[Tensor, "*batch view"]


def lit_samples(
    rows: FlatSamples,
    templates: Templates,
    registered: Observations,
    normals: PatchVectors,
    field: LightField,
    caster: RayCaster | None,
) -> tuple[Bool[Tensor, "patch view sample"], Float[Tensor, "patch view 4"]]:
    """Return the samples under first-order light, and that light.

    Args:
        caster: Of the surface that casts shadows; ``None`` for no cast shadows.
    """
    illuminated, shadowed = _illuminated(templates, registered, normals, field, caster)
    patch_from_world = templates.patch_from_world.to(normals)
    lights, soft, point_light = lights_in_patches(field, patch_from_world)
    lit = flatten_samples(illuminated, rows.index) & rows.seen
    lit &= faces_light(point_light, rows.normals)
    shaded = flatten_samples(shadowed, rows.index) | faces_light(-point_light, rows.normals)
    # Directed soft light whose shading is strong compared with the point light.
    directed, strength = (soft[..., 1:] != 0).any(dim=-1), point_light.norm(dim=-1)
    strong = directed & (strength > 0) & (soft[..., 0] - soft[..., 3] > strength / 4)
    by_soft = shaded & rows.seen & strong[..., None]
    # The room's light in views where a patch is mostly in shadow of the lamp.
    in_room = (by_soft.sum(dim=2) > lit.sum(dim=2))[..., None]
    return torch.where(in_room, by_soft, lit), torch.where(in_room, soft, lights)


@torch.no_grad()
def _illuminated(
    templates: Templates,
    registered: Observations,
    normals: PatchVectors,
    field: LightField,
    caster: RayCaster | None,
) -> tuple[PatchMasks, PatchMasks]:
    """Return the valid samples outside and inside cast shadows, except near shadow edges."""
    if caster is None:
        return registered.valid, torch.zeros_like(registered.valid)
    world_from_patch = invert_rigid(templates.patch_from_world)
    raster = templates.points_patch.shape
    points_world = transform(world_from_patch, templates.points_patch.flatten(1, 2))
    shadows = cast_shadows_on_rasters(
        field,
        caster,
        points_world.reshape(raster),
        rotate(world_from_patch, normals.flatten(1, 2)).reshape(raster),
        templates.spacing,
        registered.valid,
        # The assumed error of the surface that casts the shadows is two samples.
        tolerance=2 * templates.spacing.detach(),
        guard=2 * float(templates.spacing[0].detach()),
    )
    lit, sure = shadows.lit.movedim(-1, 1), registered.valid & shadows.sure.movedim(-1, 1)
    return lit & sure, ~lit & sure


def cast_shadows(
    field: LightField,
    caster: RayCaster,
    points: Vectors,
    normals: Vectors,
    tolerance: float | Float[Tensor, "*#batch"],
    guard: float | Float[Tensor, "*#batch"] = 0.0,
    mask: Bool[Tensor, "*batch view"] | None = None,
) -> Shadows:
    """Return shadows by a ray from every sample to the point light of every view.

    Args:
        points: World; on the surface that casts the shadows, or near it.
        normals: Unit, outward.
        tolerance: Maximum distance of the points from the surface, scene units: rays start at this
            distance along the normal, and the same again towards the point light. An object thinner
            than that does not cast a shadow on surfaces that it touches.
        guard: Maximum error, along the surface, of the predicted edge of a cast shadow; scene
            units. Above 0, six more rays are cast around each sample that faces the point light,
            and the sample is unsure if one disagrees: this detects every straight edge that near.
        mask: Where rays are cast; samples elsewhere are lit and sure.

    Returns:
        A sample that is reliably lit is ``lit & sure``. A sample that faces away from the point
        light is in attached shadow: not lit, and sure.

    Not differentiable. Ray casting is float32 on the CPU.
    """
    shape, like = points.shape[:-1], points
    flat, up = points.detach().reshape(-1, 3), normals.detach().reshape(-1, 3)
    offset = torch.as_tensor(tolerance).to(like).expand(shape).reshape(-1)
    margin = torch.as_tensor(guard).to(like).expand(shape).reshape(-1)
    ring = _hexagon(up, margin) if bool((margin > 0).any()) else None
    views = len(field.point_light)
    lit = torch.ones(len(flat), views, dtype=torch.bool, device=like.device)
    sure = torch.ones_like(lit)
    shines = field.point_light.norm(dim=1) > 0
    needed = lit & shines if mask is None else mask.reshape(-1, views) & shines
    for batch in torch.split(needed.mT.nonzero(), 150_000):  # a million rays, 100 MB
        view, sample = batch.unbind(dim=1)
        towards, _ = _direction_to_light(field, view, flat[sample])
        facing = (towards * up[sample]).sum(dim=-1) > 0
        lit[sample, view] = facing
        view, sample = view[facing], sample[facing]
        unblocked = _unblocked(field, view, caster, flat[sample], up[sample], offset[sample])
        lit[sample, view] = unblocked
        if ring is not None:
            around = flat[sample, None] + ring[sample]
            outward = up[sample, None].expand_as(around)
            same = _unblocked(field, view[:, None], caster, around, outward, offset[sample, None])
            sure[sample, view] = (same == unblocked[:, None]).all(dim=1)
    return Shadows(lit=lit.reshape(*shape, views), sure=sure.reshape(*shape, views))


def cast_shadows_on_rasters(
    field: LightField,
    caster: RayCaster,
    points: Float[Tensor, "patch height width 3"],
    normals: Float[Tensor, "patch height width 3"],
    spacing: Float[Tensor, " patch"],
    seen: Bool[Tensor, "patch view height width"],
    *,
    tolerance: float | Float[Tensor, " patch"],
    guard: float,
    stride: int = 4,
) -> Shadows:
    """Return shadows on templates, predicted from a sparse raster of rays.

    See :func:`cast_shadows`. A sample without a ray has the result of the nearest ray, and the
    distance between the two is added to the guard.

    Args:
        points: World.
        normals: World, unit, outward.
        spacing: Sample spacing, scene units, as tolerance and guard.
        seen: Where rays are cast; samples elsewhere are lit and sure.

    Returns:
        Masks of shape ``patch height width view``.
    """
    height, width = points.shape[1:3]
    rows, columns = (
        (torch.arange(0, size, stride, device=points.device) + stride // 2).clamp_max(size - 1)
        for size in (height, width)
    )
    needed = max_pool2d(seen.float(), stride, ceil_mode=True).movedim(1, -1) > 0
    blocks = needed.any(dim=-1)
    patch, row, column = blocks.nonzero(as_tuple=True)
    index = patch, rows[row], columns[column]
    offset = torch.as_tensor(tolerance).to(points).expand(len(points))
    margin = guard + 2**0.5 * (stride // 2) * spacing
    cast = cast_shadows(
        field, caster, points[index], normals[index], offset[patch], margin[patch], needed[blocks]
    )

    def spread_out(sparse: Bool[Tensor, "ray view"]) -> Bool[Tensor, "patch height width view"]:
        dense = torch.ones_like(needed).index_put((blocks,), sparse)
        dense = dense.repeat_interleave(stride, dim=1).repeat_interleave(stride, dim=2)
        return dense[:, :height, :width]

    return Shadows(lit=spread_out(cast.lit), sure=spread_out(cast.sure))


def _direction_to_light(
    field: LightField, view: Int[Tensor, "*#batch"], points: Vectors
) -> tuple[Vectors, Scalars]:
    """Return the unit direction to the point light, and its distance, which may be infinite."""
    direction = normalize(field.point_light, dim=1).to(points)[view]
    inverse_distance = field.inverse_distance.to(points)[view]
    away = direction - inverse_distance[..., None] * (points - field.origin.to(points))
    length = away.norm(dim=-1)
    far = torch.where(inverse_distance > 0, length / inverse_distance.clamp_min(1e-30), torch.inf)
    return away / length.clamp_min(1e-30)[..., None], far


def _unblocked(
    field: LightField,
    view: Int[Tensor, "*#batch"],
    caster: RayCaster,
    points: Vectors,
    normals: Vectors,
    offset: Float[Tensor, "*#batch"],
) -> Bool[Tensor, "*batch"]:
    lifted = points + offset[..., None] * normals
    towards, reach = _direction_to_light(field, view, lifted)
    return ~caster.blocked(lifted + offset[..., None] * towards, towards, reach - offset)


def _hexagon(
    normals: Float[Tensor, "sample 3"], radius: Float[Tensor, " sample"]
) -> Float[Tensor, "sample ring 3"]:
    """Return offsets in the tangent plane: the corners of a hexagon around a circle."""
    # The cross product of the normal with the axis least aligned to it does not vanish.
    axis = torch.eye(3).to(normals)[normals.abs().argmin(dim=1)]
    first_axis = normalize(torch.linalg.cross(axis, normals), dim=1)
    second_axis = torch.linalg.cross(normals, first_axis)
    angle = 2 * math.pi * torch.arange(6).to(normals) / 6
    reach = radius[:, None, None] / math.cos(math.pi / 6)
    return reach * (
        angle.cos()[:, None] * first_axis[:, None] + angle.sin()[:, None] * second_axis[:, None]
    )
