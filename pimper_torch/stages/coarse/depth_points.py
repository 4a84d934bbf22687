"""Points from depth maps for cameras given without points, if features hardly match.

Features of smooth surfaces move with the light, but windows compared through a plane still match.
The maps are those of :mod:`pimper_torch.stages.coarse.densify`, which derives the range of depths
and the views to compare from sparse points. Here candidate points that fill the space common to
several frames or masks replace these.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.geometry.lens_models import photographed
from pimper_torch.geometry.pixels import grid_from_pixels, pixels_from_indices
from pimper_torch.geometry.projection import project, rays_through, triangulate_rays
from pimper_torch.geometry.supporting_plane import fixation
from pimper_torch.records import Cameras, SparseScene, Views
from pimper_torch.records.shapes import Mask, Pixels, Points
from pimper_torch.runtime.errors import caution
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.stages.coarse.densify import DepthMaps, count_agreeing, depth_maps, nearest_pixels
from pimper_torch.stages.coarse.window_matching import Matcher, pair
from pimper_torch.stages.stage import Stage

# Candidate points that fill space, and steps of inverse depth along each ray. Choices: more take
# memory, because each candidate is compared with all views.
_NUM_CANDIDATES, _STEPS = 100_000, 48
# Range of depths searched, relative to the distance to the fixation point. A choice.
_NEAREST, _FARTHEST = 0.3, 3.0
# Points kept per view, spread evenly. A choice: with 400, borders of the surface that several views
# see are lost (Chamfer distance of 8 potatoes of 240x180: 0.177, not 0.152 % of the diagonal).
_MAX_POINTS = 1500
# Least number of views of a point.
_MIN_VIEWS = 3
# Largest reprojection error in a view, in pixels of the photographs; as for the coarse surface.
_MAX_ERROR_PX = 1.5
# Fraction of the pixels with one agreeing view that must have two: 0.83 and 0.55 with the cameras
# of rendered potatoes and of a jar with hardly any texture, 0.29 to 0.47 with those of other views.
_MIN_CONFIRMED = 0.5
# Number of resolutions at which depth is searched: 100, 200, 400 and 800 pixels.
_LEVELS = 4


class DepthPoints(Stage):
    """Add to a scene the points of depth maps that at least three views see."""

    kept_as = SparseScene

    @torch.no_grad()
    def forward(self, scene: SparseScene) -> SparseScene:
        """Return the scene with more points and the same cameras. Not differentiable.

        A :class:`~pimper_torch.runtime.errors.PimperWarning` gives the number of points.
        """
        candidates = _candidates(scene)
        index = torch.arange(len(candidates.points_world), device=candidates.points_world.device)
        if len(index) == 0:
            _warn(scene, 0)
            return scene
        maps = depth_maps(candidates, index, _LEVELS)[-1]
        once, twice = (int((maps.agreed >= count).sum()) for count in (1, 2))
        confirmed = twice >= _MIN_CONFIRMED * max(once, 1)
        leave_out("depth_points.disagreement", not confirmed)
        if not confirmed:
            _warn(scene, 0)
            return scene
        per_view = [_tracks_of(scene, maps, view) for view in range(scene.cameras.num_views)]
        pixels, seen = (torch.cat(tracks) for tracks in zip(*per_view, strict=True))
        result = _with_tracks(scene, pixels, seen)
        _warn(result, len(result.points_world) - len(scene.points_world))
        return result


def _warn(scene: SparseScene, count: int) -> None:
    if not count:
        caution(
            "No points: features do not match, and depth maps agree only by chance. The surface "
            "is reconstructed from silhouettes and light. Check that the cameras belong to these "
            "photographs. Texture, or a patterned sheet under the object, gives points.",
            stacklevel=4,
        )
        return
    error = float(scene.reprojection_errors_px[-count:].median())
    caution(
        f"Features hardly match: {count:,} points come from depth maps that agree in several "
        f"views; median reprojection error {error:.2f} px. They are less accurate than features.",
        stacklevel=4,
    )


def _candidates(scene: SparseScene) -> SparseScene:
    """Return the scene with points that fill the space in three frames and in nearly all masks."""
    cameras, views = scene.cameras, scene.views
    points = torch.cat([_along_rays(cameras, views, view) for view in range(cameras.num_views)])
    framed = torch.zeros(len(points), cameras.num_views, dtype=torch.bool, device=points.device)
    visible = framed.clone()
    for view in range(cameras.num_views):
        pixels, depth = project(points, cameras.cam_from_world[view], cameras.intrinsics[view])
        within = ((pixels > 0) & (pixels < cameras.sizes_px[view])).all(dim=1) & (depth > 0)
        column, row = torch.where(within[:, None], pixels, 0).long().unbind(dim=1)
        masked = within if views.masks is None else within & views.masks[view][row, column]
        framed[:, view], visible[:, view] = within, masked
    count, outside = framed.sum(dim=1), (framed & ~visible).sum(dim=1)
    # Tolerates errors of a few masks.
    kept = (count >= _MIN_VIEWS) & (outside <= 0.2 * count)
    point, seen_by = visible[kept].nonzero(as_tuple=True)
    inside = points[kept]
    return scene.replace(
        points_world=inside,
        reprojection_errors_px=torch.zeros_like(inside[:, 0]),
        observation_point=point,
        observation_view=seen_by,
        observation_pixels=torch.zeros_like(inside[point, :2]),
    )


def _along_rays(cameras: Cameras, views: Views, view: int) -> Points:
    """Return points on a view's rays, evenly spaced in inverse depth."""
    width, height = cameras.sizes_px[view].tolist()
    step = math.sqrt(width * height * cameras.num_views * _STEPS / _NUM_CANDIDATES)
    across, down = (torch.arange(step / 2, side, step) for side in (width, height))
    pixels = torch.cartesian_prod(across, down).to(cameras.intrinsics)
    if views.masks is not None:
        column, row = pixels.long().unbind(dim=1)
        pixels = pixels[views.masks[view][row, column]]
    # Depth of the point nearest to all optical axes, or else distance to the farthest camera.
    poses, centers = cameras.cam_from_world, cameras.centers_world
    distance = (fixation(poses).fixation_world - centers[view]) @ poses[view, 2, :3]
    if distance <= 0:
        distance = (centers - centers[view]).norm(dim=1).max()
    inverse = torch.linspace(1 / _FARTHEST, 1 / _NEAREST, _STEPS).to(pixels) / distance
    rays = rays_through(pixels, poses[view], cameras.intrinsics[view])
    return (centers[view] + rays[:, None] / inverse[:, None]).reshape(-1, 3)


def _tracks_of(
    scene: SparseScene, maps: DepthMaps, view: int
) -> tuple[Float[Tensor, "point view 2"], Bool[Tensor, "point view"]]:
    """Return the pixels of points of one depth map in all views, and in which they are visible.

    The points are those with which another depth map agrees. In sources whose depth map agrees,
    the pixel follows from it; in sources that only look alike, from this view's map.
    """
    valid = maps.agreed[view] > 0
    step = max(1, math.ceil(math.sqrt(int(valid.sum()) / _MAX_POINTS)))
    chosen = torch.zeros_like(valid)
    chosen[step // 2 :: step, step // 2 :: step] = True
    chosen &= valid
    centers = pixels_from_indices(chosen.nonzero().flip(1).to(maps.inverse_depth))
    count = scene.cameras.num_views
    pixels = centers.new_zeros(len(centers), count, 2)
    seen = torch.zeros(len(centers), count, dtype=torch.bool, device=centers.device)
    pixels[:, view], seen[:, view] = centers, True
    for source in maps.sources[view][maps.sources[view] >= 0].tolist():
        pixels[:, source], seen[:, source] = _in_source(maps, view, source, chosen)
    enough = seen.sum(dim=1) >= _MIN_VIEWS
    return pixels[enough] * maps.factor, seen[enough]


def _in_source(
    maps: DepthMaps, view: int, source: int, chosen: Mask
) -> tuple[Pixels, Bool[Tensor, " point"]]:
    index = torch.tensor([source], device=chosen.device)
    pairing = pair(maps.level, view, index)
    field, valid = maps.inverse_depth[view], maps.agreed > 0
    agrees = count_agreeing(maps.level, maps.inverse_depth, valid, view, index)[chosen] > 0
    alike = Matcher(maps.level, pairing).scores(field, [0.0])[0, chosen] >= 0.5
    rays = pairing.replace(ray=pairing.ray[:, :, chosen])
    height, width = chosen.shape
    grid = grid_from_pixels(rays.project(field[chosen])[0].movedim(1, -1), width, height)
    depth = 1 / nearest_pixels(maps.inverse_depth[index], grid).clamp_min(1e-9)
    # Inverse depth on the ray whose depth in the source is that of the source's map.
    by_source = (rays.ray[:, 2] / (depth - rays.shift[:, 2:]))[0]
    agrees = agrees & (by_source > 0)
    pixels, _ = rays.project(torch.where(agrees, by_source, field[chosen]))
    return pixels[0].mT, agrees | alike


def _with_tracks(
    scene: SparseScene, pixels: Float[Tensor, "point view 2"], seen: Bool[Tensor, "point view"]
) -> SparseScene:
    """Triangulate points, and append them and their tracks to those of the scene."""
    cameras = scene.cameras
    exact = cameras.to(torch.float64)
    points = triangulate_rays(exact, pixels.double(), seen)
    expected, depth = project(points, exact.cam_from_world, exact.intrinsics)
    error = (expected.movedim(0, 1) - pixels).norm(dim=-1)
    seen = seen & (error <= _MAX_ERROR_PX) & (depth.mT > 0)
    kept = seen.sum(dim=1) >= _MIN_VIEWS
    leave_out("depth_points.points", ~kept, at=points)
    points, seen, error, pixels = points[kept], seen[kept], error[kept], pixels[kept]
    point, view = seen.nonzero(as_tuple=True)
    like, offset = scene.points_world, len(scene.points_world)
    mean = (error * seen).sum(dim=1) / seen.sum(dim=1).clamp_min(1)
    distorted = photographed(scene, pixels[point, view], view)
    return scene.replace(
        points_world=torch.cat([like, points.to(like)]),
        reprojection_errors_px=torch.cat([scene.reprojection_errors_px, mean.to(like)]),
        observation_point=torch.cat([scene.observation_point, point + offset]),
        observation_view=torch.cat([scene.observation_view, view]),
        observation_pixels=torch.cat([scene.observation_pixels, distorted.to(like)]),
    )
