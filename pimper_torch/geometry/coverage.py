"""Comparison of a surface with silhouettes, by rays through their pixels."""

import math

import torch
from torch import Tensor

from pimper_torch.geometry.pixels import pixels_from_indices
from pimper_torch.geometry.projection import rays_through
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.geometry.visibility import ray_caster
from pimper_torch.records import Cameras, Mesh, SilhouetteCoverage, Silhouettes, Surface
from pimper_torch.runtime.parallel import side_by_side


@torch.no_grad()
def coverage_by(
    surface: Mesh | Surface, silhouettes: Silhouettes, cameras: Cameras
) -> SilhouetteCoverage:
    """Return the fractions of every reliable silhouette that a surface lacks or exceeds.

    None if they constrain nothing. Rays are through some 20,000 pixels. Not differentiable.
    """
    vertices = surface.vertices_world
    normals = face_normals(vertices, surface.faces)
    cameras = cameras.to(vertices.dtype)

    def of_view(view: int) -> Tensor:
        width, height = cameras.sizes_px[view].tolist()
        step = max(1, round(math.sqrt(width * height / 20_000)))
        rows, columns = (torch.arange(step // 2, side, step) for side in (height, width))
        inside = silhouettes.inside[view, rows][:, columns].to(vertices)
        pixels = pixels_from_indices(torch.cartesian_prod(columns, rows).to(vertices))
        rays = rays_through(pixels, cameras.cam_from_world[view], cameras.intrinsics[view])
        face = ray_caster(surface).cast(cameras.centers_world[view], rays).face
        front = (face >= 0) & ((normals[face.clamp_min(0)] * rays).sum(dim=1) < 0)
        hit, covered = (x.reshape(len(columns), len(rows)).mT for x in (face >= 0, front))
        area = (inside > 0.5).sum().clamp_min(1)
        outside = (hit * (1 - 2 * inside).clamp_min(0)).sum()
        return torch.stack([((inside > 0.5) & ~covered).sum() / area, outside / area])

    views = (silhouettes.reliable & (silhouettes.source != "everything")).nonzero()[:, 0].tolist()
    rows = [vertices.new_zeros(0, 2), *(row[None] for row in side_by_side(of_view, views))]
    uncovered, outside = torch.cat(rows).unbind(dim=1)
    return SilhouetteCoverage(uncovered=uncovered, outside=outside)
