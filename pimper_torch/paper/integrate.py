"""Integration: normals of every patch become its height field."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.geometry.frames import transform
from pimper_torch.geometry.height_fields import sample_raster
from pimper_torch.geometry.surfaces import slopes_from_normals
from pimper_torch.paper.filling import fill_smoothly
from pimper_torch.paper.poisson import integrate_steps
from pimper_torch.progress import track
from pimper_torch.records import CoarseMesh, DepthPatches, Depths, PhotometricPatches
from pimper_torch.records.patches import Photometry, Templates
from pimper_torch.stage import Stage

# Normals farther from the facet's own are brought to this angle, that of the warp's limit: such a
# sample lies on the contour or is wrong, and one alone can bend its whole patch.
_MAX_TILT_DEG = 75.0


class Integrate(Stage):
    """Integrate the normals of every patch on its template.

    Frankot and Chellappa's projection in the cosine basis, bucket by bucket. Samples without
    normals, and the raster outside the enlarged triangle, get slopes filled in smoothly from
    the samples around them; a patch without any normals stays its facet's plane. The free
    constant is chosen so that the height field passes, on average, through the facet's corners.

    Differentiable in normals.

    Source: Frankot & Chellappa, A method for enforcing integrability in shape from shading
    algorithms, PAMI 10(4), 1988.
    """

    def forward(self, photometric: PhotometricPatches) -> DepthPatches:
        """Give every patch its height field; ``valid`` inside enlarged triangles that have data."""
        steepest = math.tan(math.radians(_MAX_TILT_DEG))
        pairs = list(zip(photometric.patches.buckets, photometric.buckets, strict=True))
        buckets = []
        for templates, photometry in track(pairs):
            height_field = integrate_normals(
                photometry.normals_patch,
                photometry.valid,
                templates.spacing,
                steepest,
            )
            depth = through_corners(height_field, templates, photometric.patches.coarse)
            buckets.append(_depths(depth, templates, photometry))
        return DepthPatches(photometric=photometric, buckets=tuple(buckets))


def integrate_normals(
    normals: Float[Tensor, "patch height width 3"],
    valid: Bool[Tensor, "patch height width"],
    spacing: Float[Tensor, " patch"],
    steepest: float,
) -> Float[Tensor, "patch height width"]:
    """Find the height field, of mean zero over its raster, whose slopes are the normals'.

    Args:
        normals: Unit, ``n_z < 0``; anything where not valid.
        spacing: Between samples, in the units of the depth.
        steepest: Limit of a slope's size.
    """
    slopes = _slopes(normals, valid, steepest).movedim(-1, 1)
    slopes = fill_smoothly(slopes, valid.to(slopes)).double() * spacing[:, None, None, None]
    # Half-way between samples the mean of the two is right to second order.
    right = (slopes[:, 0, :, 1:] + slopes[:, 0, :, :-1]) / 2
    down = (slopes[:, 1, 1:] + slopes[:, 1, :-1]) / 2
    return integrate_steps(right, down).to(normals)


def _slopes(
    normals: Float[Tensor, "patch height width 3"],
    valid: Bool[Tensor, "patch height width"],
    steepest: float,
) -> Float[Tensor, "patch height width 2"]:
    """Return the slopes of valid normals, at most so steep, and 0 elsewhere."""
    upright = torch.zeros_like(normals)
    upright[..., 2] = -1
    return slopes_from_normals(torch.where(valid[..., None], normals, upright), steepest)


def through_corners(
    height_field: Float[Tensor, "patch height width"], templates: Templates, coarse: CoarseMesh
) -> Float[Tensor, "patch height width"]:
    """Shift height fields along z so that they pass, on average, through their facets' corners."""
    vertices = coarse.mesh.vertices_world[coarse.mesh.faces[templates.facet]]
    corners = transform(templates.patch_from_world, vertices)
    found = sample_raster(
        height_field[:, None], corners[..., :2], templates.origin, templates.spacing
    )
    offset = (found[:, 0] - corners[..., 2]).mean(dim=1)
    return height_field - offset[:, None, None]


def _depths(
    depth: Float[Tensor, "patch height width"], templates: Templates, photometry: Photometry
) -> Depths:
    has_data = photometry.valid.flatten(1).any(dim=1)
    identity = depth.new_tensor([0, 0, 1, 0]).expand(len(depth), 4)
    return Depths(
        depth=depth,
        valid=templates.inside & has_data[:, None, None],
        transform=identity,
    )
