"""Sparse clouds with tracks from ground truth, in the form of structure from motion's."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_bench.scenes.render_in_memory import RenderedScene
from pimper_torch.geometry.lens_models import pinhole_lenses
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import project, rays_through, triangulate_rays
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import Cameras, Mesh, SparseScene, Views
from pimper_torch.records.sparse_model import SparseModel


def sparse_scene(
    scene: RenderedScene,
    num_points: int,
    generator: torch.Generator,
    *,
    noise_px: float = 0.0,
    dtype: torch.dtype = torch.float32,
) -> SparseScene:
    """Sample visible surface points, track them through the views and triangulate them.

    Noise is added to the observations, and the points are triangulated from these, so that
    their errors are along the rays as in real clouds.

    Args:
        noise_px: Standard deviation of every observation.
        dtype: Of photographs, cameras and points.
    """
    cameras = scene.cameras
    points = _draw(scene, 4 * num_points, generator)
    pixels, seen = tracked(cameras, scene.depth, points)
    (kept,) = torch.nonzero(seen.sum(dim=1) >= 3, as_tuple=True)
    kept = kept[:num_points]
    points, pixels, seen = points[kept], pixels[kept], seen[kept]
    return triangulated(
        scene.views, cameras, points, pixels, seen, generator, noise_px=noise_px, dtype=dtype
    )


def triangulated(
    views: Views,
    cameras: Cameras,
    points: Float[Tensor, "point 3"],
    pixels: Float[Tensor, "point view 2"],
    seen: Bool[Tensor, "point view"],
    generator: torch.Generator,
    *,
    noise_px: float,
    dtype: torch.dtype = torch.float32,
) -> SparseScene:
    """Return a cloud from exact points, their pixels and the views that see them.

    Args:
        noise_px: Added to the pixels, from which the points are then triangulated.
        dtype: Of photographs, cameras and points.
    """
    if noise_px > 0:
        spread = torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
        pixels = pixels + noise_px * spread.to(pixels)
        points = triangulate_rays(cameras, pixels, seen)
    projected = project(points, cameras.cam_from_world, cameras.intrinsics)[0].movedim(0, 1)
    errors = (projected - pixels).norm(dim=-1)
    point_index, view_index = torch.nonzero(seen, as_tuple=True)
    return SparseScene(
        views=views.replace(images=views.images.to(dtype)),
        cameras=cameras.replace(
            intrinsics=cameras.intrinsics.to(dtype), cam_from_world=cameras.cam_from_world.to(dtype)
        ),
        points_world=points.to(dtype),
        reprojection_errors_px=((errors * seen).sum(dim=1) / seen.sum(dim=1)).to(dtype),
        observation_point=point_index,
        observation_view=view_index,
        observation_pixels=pixels[seen].to(dtype),
        lenses=pinhole_lenses(cameras),
    )


def _draw(scene: RenderedScene, count: int, generator: torch.Generator) -> Float[Tensor, "point 3"]:
    """Unproject random pixels of the depth maps."""
    cameras, points_of = scene.cameras, []
    per_view = -(-count // cameras.num_views)
    for view in range(cameras.num_views):
        width, height = (int(side) for side in cameras.sizes_px[view])
        depth = scene.depth[view].to(cameras.intrinsics).reshape(-1)
        (hit,) = torch.nonzero(depth.isfinite(), as_tuple=True)
        hit = hit[torch.randperm(len(hit), generator=generator)[:per_view]]
        pixels = pixel_centers(width, height, like=cameras.intrinsics).reshape(-1, 2)[hit]
        rays = rays_through(pixels, cameras.cam_from_world[view], cameras.intrinsics[view])
        points_of.append(cameras.centers_world[view] + depth[hit, None] * rays)
    points = torch.cat(points_of)
    return points[torch.randperm(len(points), generator=generator)]


def tracked(
    cameras: Cameras, depths: Float[Tensor, "view height width"], points: Float[Tensor, "point 3"]
) -> tuple[Float[Tensor, "point view 2"], Bool[Tensor, "point view"]]:
    """Project points to all views, and return where the depth maps confirm their depth.

    A point is seen if the depths of the 3x3 pixels around it bracket its depth and
    are on one surface. The rim of an object, and the image's border, are excluded.
    """
    pixels, depth = project(points, cameras.cam_from_world, cameras.intrinsics)
    seen = torch.zeros(depth.shape, dtype=torch.bool)
    for view in range(cameras.num_views):
        width, height = (int(side) for side in cameras.sizes_px[view])
        u, v = pixels[view].floor().long().unbind(dim=-1)
        framed = (depth[view] > 0) & (u >= 1) & (v >= 1) & (u < width - 1) & (v < height - 1)
        (inside,) = torch.nonzero(framed, as_tuple=True)
        patch = torch.stack(
            [depths[view, v[inside] + dv, u[inside] + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)]
        ).to(depth)
        z = depth[view, inside]
        slack = 1e-4 * z
        smooth = patch.amax(dim=0) - patch.amin(dim=0) < 0.05 * z
        bracketed = (z > patch.amin(dim=0) - slack) & (z < patch.amax(dim=0) + slack)
        seen[view, inside] = smooth & bracketed
    return pixels.movedim(0, 1), seen.mT


def true_model(
    surface: Mesh,
    blockers: Mesh,
    cameras: Cameras,
    names: tuple[str, ...],
    generator: torch.Generator,
) -> tuple[SparseModel, Float[Tensor, "point channel"]]:
    """Sample points uniformly on a surface and track them through the photographs.

    Args:
        blockers: All surfaces that may occlude it.

    Returns:
        Cameras, at most 1,500 points with exact observations, and the points' albedo.
    """
    points, normals, albedo = _sampled_surface(surface, 6 * 1500, generator)
    pixels, depth = project(points, cameras.cam_from_world, cameras.intrinsics)
    seen = _visible(points, normals, pixels, depth, blockers, cameras)
    fewest = min(3, cameras.num_views)
    (kept,) = torch.nonzero(seen.sum(dim=0) >= fewest, as_tuple=True)
    kept = kept[:1500]
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


def _sampled_surface(
    mesh: Mesh, count: int, generator: torch.Generator
) -> tuple[Float[Tensor, "point 3"], Float[Tensor, "point 3"], Float[Tensor, "point channel"]]:
    """Return points uniform by area, the normals of their faces, and their albedo."""
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


def _visible(
    points: Float[Tensor, "point 3"],
    normals: Float[Tensor, "point 3"],
    pixels: Float[Tensor, "view point 2"],
    depth: Float[Tensor, "view point"],
    blockers: Mesh,
    cameras: Cameras,
) -> Bool[Tensor, "view point"]:
    caster = RayCaster(blockers.vertices_world, blockers.faces)
    visible = []
    for view in range(cameras.num_views):
        eye = cameras.centers_world[view]
        toward = eye - points
        distance = toward.norm(dim=-1)
        # Features are not detected on more slanted surface.
        facing = (normals * toward).sum(dim=-1) > 0.2 * distance
        size = cameras.sizes_px[view].to(pixels)
        framed = (depth[view] > 0) & ((pixels[view] > 1) & (pixels[view] < size - 1)).all(dim=-1)
        hidden = caster.occluded(points, eye, 1e-3 * distance)
        visible.append(facing & framed & ~hidden)
    return torch.stack(visible)
