"""Points of a mesh and where photographs show them: a sparse model from the truth."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.geometry.projection import project
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import Cameras, Mesh
from pimper_torch.sfm.colmap import pinhole_lenses
from pimper_torch.sfm.model import SparseModel

_STEEPEST = 0.2  # cosine below which a surface is too slanted for its features to be found
_CLEARANCE = 1e-3  # of the distance to the camera


def true_model(
    surface: Mesh,
    blockers: Mesh,
    cameras: Cameras,
    names: tuple[str, ...],
    generator: torch.Generator,
    *,
    num_points: int = 1500,
    min_views: int = 3,
) -> tuple[SparseModel, Float[Tensor, "point channel"]]:
    """Draw points evenly over a surface and follow them through the photographs.

    Args:
        surface: Where the points lie; it has an albedo.
        blockers: Everything that may stand in front of them.
        num_points: At most; fewer where less of the surface is seen.
        min_views: Views that see a point at least, or all there are.

    Returns:
        Cameras, points and exact observations, and the points' albedo.
    """
    points, normals, albedo = _scatter(surface, 6 * num_points, generator)
    pixels, depth = project(points, cameras.cam_from_world, cameras.intrinsics)
    seen = _seen(points, normals, pixels, depth, blockers, cameras)
    fewest = min(min_views, cameras.num_views)
    (kept,) = torch.nonzero(seen.sum(dim=0) >= fewest, as_tuple=True)
    kept = kept[:num_points]
    point, view = torch.nonzero(seen[:, kept].mT, as_tuple=True)
    model = SparseModel(
        names=names,
        lenses=pinhole_lenses(cameras),
        cam_from_world=cameras.cam_from_world.double(),
        points_world=points[kept],
        observation_point=point,
        observation_view=view,
        observation_pixels=pixels[view, kept[point]],
    )
    return model, albedo[kept]


def _scatter(
    mesh: Mesh, count: int, generator: torch.Generator
) -> tuple[Float[Tensor, "point 3"], Float[Tensor, "point 3"], Float[Tensor, "point channel"]]:
    """Draw points, their faces' normals and their albedo, evenly by area."""
    assert mesh.albedo is not None
    normals = face_normals(mesh.vertices_world, mesh.faces)
    area = normals.norm(dim=-1).cumsum(dim=0)
    draws = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    face = torch.searchsorted(area, draws[:, 0] * area[-1]).clamp_max(len(mesh.faces) - 1)
    root = draws[:, 1].sqrt()
    weights = torch.stack([1 - root, root * (1 - draws[:, 2]), root * draws[:, 2]], dim=-1)
    corners = mesh.faces[face]
    points = (weights[..., None] * mesh.vertices_world[corners]).sum(dim=1)
    albedo = (weights[..., None] * mesh.albedo.double()[corners]).sum(dim=1)
    return points, normals[face] / normals[face].norm(dim=-1, keepdim=True), albedo


def _seen(
    points: Float[Tensor, "point 3"],
    normals: Float[Tensor, "point 3"],
    pixels: Float[Tensor, "view point 2"],
    depth: Float[Tensor, "view point"],
    blockers: Mesh,
    cameras: Cameras,
) -> Bool[Tensor, "view point"]:
    caster = RayCaster(blockers.vertices_world, blockers.faces)
    found = []
    for view in range(cameras.num_views):
        eye = cameras.centers_world[view]
        toward = eye - points
        distance = toward.norm(dim=-1)
        facing = (normals * toward).sum(dim=-1) > _STEEPEST * distance
        size = cameras.sizes_px[view].to(pixels)
        framed = (depth[view] > 0) & ((pixels[view] > 1) & (pixels[view] < size - 1)).all(dim=-1)
        hidden = caster.occluded(points, eye, _CLEARANCE * distance)
        found.append(facing & framed & ~hidden)
    return torch.stack(found)
