"""Rasters to rows of samples and back: padding outside the templates costs nothing."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.frames import rotate
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.records import CoarseMesh, Record, Registered, Templates

# Coarse normals are kept this far from the rim, so that all of them face the viewer.
LEAST_FACING = 0.05


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Rows(Record):
    """The samples inside the templates of some patches, in a row, padded to the longest.

    Attributes:
        place: Where in the flattened raster each sample stands; padding points to samples
            outside the template.
        radiance: Linear; zero where missing.
        seen: ``D``; false where radiance is not finite.
        normals: Of the coarse mesh, patch frame.
    """

    place: Int[Tensor, "patch sample"]
    radiance: Float[Tensor, "patch view channel sample"]
    seen: Bool[Tensor, "patch view sample"]
    normals: Float[Tensor, "patch sample 3"]


def coarse_normals(
    coarse: CoarseMesh, templates: Templates
) -> Float[Tensor, "patch height width 3"]:
    """Blend the mesh's smoothed vertex normals over every template, patch frame.

    Outside the facet barycentric coordinates are clamped to it, as the blend would
    otherwise run away. All face the viewer.
    """
    mesh = coarse.mesh
    per_vertex = mesh.normals_world
    if per_vertex is None:
        per_vertex = vertex_normals(mesh.vertices_world, mesh.faces)
    corners = rotate(templates.patch_from_world, per_vertex[mesh.faces[templates.facet]])
    inner = templates.barycentric.clamp_min(0)
    inner = inner / inner.sum(dim=-1, keepdim=True)
    blend = torch.einsum("phwc,pcx->phwx", inner, corners.to(inner))
    unit = normalize(blend, dim=-1)
    facing = unit[..., 2:].clamp_max(-LEAST_FACING)
    aside = (1 - facing**2).clamp_min(0).sqrt() * normalize(unit[..., :2], dim=-1)
    return torch.where(unit[..., 2:] > -LEAST_FACING, torch.cat([aside, facing], dim=-1), unit)


def rows_of(
    templates: Templates, registered: Registered, normals: Float[Tensor, "patch height width 3"]
) -> Rows:
    """Put the samples inside each template in a row."""
    inside = templates.inside.flatten(1)
    longest = max(int(inside.sum(dim=1).max()), 1) if len(inside) else 1
    place = torch.argsort((~inside).to(torch.uint8), dim=1, stable=True)[:, :longest]
    within = inside.gather(1, place)
    num_views, num_channels = registered.radiance.shape[1:3]
    by_view = place[:, None].expand(-1, num_views, -1)
    by_channel = by_view[:, :, None].expand(-1, -1, num_channels, -1)
    radiance = registered.radiance.flatten(3).gather(3, by_channel)
    seen = registered.valid.flatten(2).gather(2, by_view) & within[:, None]
    seen = seen & radiance.isfinite().all(dim=2)
    return Rows(
        place=place,
        radiance=torch.where(seen[:, :, None], radiance, 0),
        seen=seen,
        normals=normals.flatten(1, 2).gather(1, place[..., None].expand(-1, -1, 3)),
    )


def on_raster(
    row: Float[Tensor, "patch sample *channel"] | Bool[Tensor, "patch sample"],
    place: Int[Tensor, "patch sample"],
    background: Float[Tensor, "patch height width *channel"] | Bool[Tensor, "patch height width"],
) -> Float[Tensor, "patch height width *channel"] | Bool[Tensor, "patch height width"]:
    """Put a row back on its raster, over a background."""
    index = place if row.ndim == 2 else place[..., None].expand_as(row)
    return background.flatten(1, 2).scatter(1, index, row).reshape(background.shape)
