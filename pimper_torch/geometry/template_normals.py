"""Normals of templates: of the template's own surface, or of the coarse mesh."""

import torch
from torch.nn.functional import normalize

from pimper_torch.geometry.rigid import rotate
from pimper_torch.geometry.surfaces import carried_normals
from pimper_torch.records import CoarseMesh, Templates
from pimper_torch.records.shapes import PatchVectors, Vectors

# Minimum cosine between a normal and the direction to the viewer. A choice: 87 degrees.
MIN_FACING = 0.05


def transferred_normals(coarse: CoarseMesh, templates: Templates) -> PatchVectors:
    """Return the normals of a template, patch frame: its own, or else those of the mesh."""
    if templates.normals_patch is None:
        return coarse_normals(coarse, templates)
    return facing_viewer(templates.normals_patch)


def coarse_normals(coarse: CoarseMesh, templates: Templates) -> PatchVectors:
    """Interpolate the mesh's vertex normals over every template, patch frame.

    Barycentric coordinates are clamped to the facet: no extrapolation. Normals face the viewer.
    """
    mesh = coarse.mesh
    per_corner = carried_normals(mesh)[mesh.faces[templates.facet]]
    corners = rotate(templates.patch_from_world, per_corner)
    inner = templates.barycentric.clamp_min(0)
    inner = inner / inner.sum(dim=-1, keepdim=True)
    return facing_viewer(torch.einsum("phwc,pcx->phwx", inner, corners.to(inner)))


def facing_viewer(normals: Vectors) -> Vectors:
    """Normalize normals, and rotate those that face away until they just face the viewer."""
    unit = normalize(normals, dim=-1)
    aside = (1 - MIN_FACING**2) ** 0.5 * normalize(unit[..., :2], dim=-1)
    rotated = torch.cat([aside, torch.full_like(unit[..., 2:], -MIN_FACING)], dim=-1)
    return torch.where(unit[..., 2:] > -MIN_FACING, rotated, unit)
