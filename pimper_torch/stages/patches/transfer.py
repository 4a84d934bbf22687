"""Transfer of a surface to templates, on which views are then registered."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.rigid import invert_rigid, rotate, transform
from pimper_torch.geometry.surfaces import carried_normals, face_normals
from pimper_torch.geometry.visibility import Hits, RayCaster, ray_caster
from pimper_torch.records import Mesh, PatchSet, Templates
from pimper_torch.records.shapes import Vertices
from pimper_torch.runtime.memory import recomputed
from pimper_torch.runtime.parallel import side_by_side

SampleMask = Bool[Tensor, "patch sample"]
SampleVectors = Float[Tensor, "patch sample 3"]


def transfer(patches: PatchSet, surface: Mesh) -> PatchSet:
    """Return patches whose templates have the depth and normals of a surface.

    The point of a sample is the intersection of its line along the facet's normal with surface
    that faces like the facet, nearest to the facet's plane. Samples without one, or with one
    farther than half the template's extent, are no longer ``inside``.

    Differentiable in the surface's vertices and normals and in the frames; hit faces are constant.
    """
    normals, caster = carried_normals(surface), ray_caster(surface)

    def transferred(templates: Templates) -> Templates:
        with torch.no_grad():
            # A little farther, so that rounding does not decide.
            hits, valid = _nearest(caster, *_lines(templates), surface, 1.01 * _reach(templates))
        return recomputed(_on_surface, surface, normals, templates, hits, valid)

    buckets = tuple(side_by_side(transferred, patches.buckets, tracked=False))
    return patches.replace(buckets=buckets, surface=surface.replace(normals_world=normals))


def _lines(templates: Templates) -> tuple[SampleVectors, SampleVectors]:
    """Return sample positions on the facets' planes and their inward directions, world."""
    world_from_patch = invert_rigid(templates.patch_from_world)
    flat = templates.replace(depth=torch.zeros_like(templates.depth)).points_patch
    positions = transform(world_from_patch, flat.flatten(1, 2))
    return positions, world_from_patch[:, None, :3, 2].expand_as(positions)


def _reach(templates: Templates) -> Float[Tensor, "patch 1"]:
    return 0.5 * templates.spacing[:, None] * max(templates.depth.shape[1:])


def _on_surface(
    surface: Mesh, normals: Vertices, templates: Templates, hits: Hits, valid: SampleMask
) -> Templates:
    """Return templates with the depth and normals where their lines hit the given faces."""
    positions, inward = _lines(templates)
    hits = hits.refined(surface.vertices_world, surface.faces, positions, inward)
    points = hits.interpolate(surface.vertices_world, surface.faces)
    depth = transform(templates.patch_from_world, points)[..., 2]
    rotated = rotate(templates.patch_from_world, hits.interpolate(normals, surface.faces))
    valid = valid & (depth.abs() <= _reach(templates))
    raster = templates.depth.shape
    return templates.replace(
        depth=torch.where(valid, depth, 0).reshape(raster),
        normals_patch=normalize(
            torch.where(valid[..., None], rotated, rotated.new_tensor([0, 0, -1])), dim=-1
        ).reshape(*raster, 3),
        inside=templates.inside & valid.reshape(raster),
    )


def _nearest(
    caster: RayCaster,
    positions: SampleVectors,
    inward: SampleVectors,
    surface: Mesh,
    reach: Float[Tensor, "patch 1"],
) -> tuple[Hits, SampleMask]:
    """Return the nearer of the hits on both sides among faces that face outward."""
    below, above = caster.cast(positions, inward, reach), caster.cast(positions, -inward, reach)

    def faces_outward(hits: Hits) -> SampleMask:
        faces = surface.faces[hits.face.clamp_min(0).flatten()]
        outward = face_normals(surface.vertices_world, faces).reshape(inward.shape)
        return (hits.face >= 0) & ((outward * inward).sum(dim=-1) < 0)

    hit_below, hit_above = faces_outward(below), faces_outward(above)
    first = hit_below & (~hit_above | (below.distance <= above.distance))
    return below.where(first, above), hit_below | hit_above
