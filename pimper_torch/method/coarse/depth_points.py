"""Points of depth maps for cameras that come without points, where features hardly match.

Features of smooth surfaces move with the light; windows that are compared through a plane are found
in other views all the same. The maps are those of :mod:`pimper_torch.method.coarse.densify`, which
need to know between which depths to search and which views to compare: that comes from space that
several views have in their frames, or in their masks.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.ground.geometry.lens_models import photographed
from pimper_torch.ground.geometry.pixels import grid_from_pixels
from pimper_torch.ground.geometry.projection import project, rays_through, triangulate_rays
from pimper_torch.ground.geometry.supporting_plane import fixation
from pimper_torch.ground.shapes import Mask, Pixels, Points
from pimper_torch.method.coarse.densify import DepthMaps, agreeing, depth_maps, nearest_pixels
from pimper_torch.method.coarse.window_matching import Matcher, pair
from pimper_torch.records import Cameras, SparseScene, Views
from pimper_torch.runtime.errors import caution
from pimper_torch.runtime.ledger import leave_out

# Points that fill space, and steps of inverse depth along each ray: choices. More take memory, as
# each is compared with all views.
_ROOM, _STEPS = 100_000, 48
# Depths that are searched, in distances to where the cameras look. A choice.
_NEAREST, _FARTHEST = 0.3, 3.0
# Points a view that are kept, spread evenly. A choice: with 400 borders of what several views see
# are lost (Chamfer distance of 8 potatoes of 240x180 0.177 in place of 0.152 % of the diagonal).
_MOST = 1500
# Views that a point must be found in.
_FEWEST_VIEWS = 3
# Pixels of the photographs that a point may be off in a view: what the coarse surface asks, too.
_MAX_ERROR_PX = 1.5
# Fraction of the pixels with one agreeing view that must have two: 0.83 and 0.55 with the cameras
# of rendered potatoes and of a jar with hardly any texture, 0.29 to 0.47 with other views'.
_MIN_CONFIRMED = 0.5
# Sizes at which depth is searched: 100, 200, 400 and 800 pixels.
_LEVELS = 4


@torch.no_grad()
def depth_points(scene: SparseScene) -> SparseScene:
    """Return a scene points of depth maps that three views show, beside its own.

    Returns:
        Cameras untouched. A constant to autograd. A
        :class:`~pimper_torch.runtime.errors.PimperWarning` says how many there are.
    """
    room = _room(scene)
    everywhere = torch.arange(len(room.points_world), device=room.points_world.device)
    if len(everywhere) == 0:
        _warn(scene, 0)
        return scene
    maps = depth_maps(room, everywhere, _LEVELS)[-1]
    once, twice = (int((maps.agreed >= count).sum()) for count in (1, 2))
    confirmed = twice >= _MIN_CONFIRMED * max(once, 1)
    leave_out("depth_points.disagreement", not confirmed)
    if not confirmed:
        _warn(scene, 0)
        return scene
    parts = [_points_of(scene, maps, view) for view in range(scene.cameras.num_views)]
    pixels, seen = (torch.cat(part) for part in zip(*parts, strict=True))
    found = _with(scene, pixels, seen)
    _warn(found, len(found.points_world) - len(scene.points_world))
    return found


def _warn(scene: SparseScene, count: int) -> None:
    if not count:
        caution(
            "No points: features do not match, and depth maps agree by chance alone. The surface "
            "comes from silhouettes and light. Look whether the cameras are those of these "
            "photographs; texture, or a patterned sheet under the object, gives points.",
            stacklevel=4,
        )
        return
    error = float(scene.reprojection_errors_px[-count:].median())
    caution(
        f"Features hardly match: {count:,} points were taken from depth maps that several views "
        f"agree with; median reprojection error {error:.2f} px. They are less exact than features.",
        stacklevel=4,
    )


def _room(scene: SparseScene) -> SparseScene:
    """Fill what three views have in their frames, and hardly a mask lacks, with points."""
    cameras, views = scene.cameras, scene.views
    points = torch.cat([_along_rays(cameras, views, view) for view in range(cameras.num_views)])
    framed = torch.zeros(len(points), cameras.num_views, dtype=torch.bool, device=points.device)
    shown = framed.clone()
    for view in range(cameras.num_views):
        pixels, depth = project(points, cameras.cam_from_world[view], cameras.intrinsics[view])
        within = ((pixels > 0) & (pixels < cameras.sizes_px[view])).all(dim=1) & (depth > 0)
        column, row = torch.where(within[:, None], pixels, 0).long().unbind(dim=1)
        masked = within if views.masks is None else within & views.masks[view][row, column]
        framed[:, view], shown[:, view] = within, masked
    count, lacking = framed.sum(dim=1), (framed & ~shown).sum(dim=1)
    # Masks err, too.
    kept = (count >= _FEWEST_VIEWS) & (lacking <= 0.2 * count)
    point, seen_by = shown[kept].nonzero(as_tuple=True)
    inside = points[kept]
    return scene.replace(
        points_world=inside,
        reprojection_errors_px=torch.zeros_like(inside[:, 0]),
        observation_point=point,
        observation_view=seen_by,
        observation_pixels=torch.zeros_like(inside[point, :2]),
    )


def _along_rays(cameras: Cameras, views: Views, view: int) -> Points:
    """Put points on a view's rays, evenly in inverse depth."""
    width, height = cameras.sizes_px[view].tolist()
    step = math.sqrt(width * height * cameras.num_views * _STEPS / _ROOM)
    across, down = (torch.arange(step / 2, side, step) for side in (width, height))
    pixels = torch.cartesian_prod(across, down).to(cameras.intrinsics)
    if views.masks is not None:
        column, row = pixels.long().unbind(dim=1)
        pixels = pixels[views.masks[view][row, column]]
    # To the point nearest to all optical axes, or else to the other cameras.
    poses, centers = cameras.cam_from_world, cameras.centers_world
    distance = (fixation(poses).fixation_world - centers[view]) @ poses[view, 2, :3]
    if distance <= 0:
        distance = (centers - centers[view]).norm(dim=1).max()
    inverse = torch.linspace(1 / _FARTHEST, 1 / _NEAREST, _STEPS).to(pixels) / distance
    rays = rays_through(pixels, poses[view], cameras.intrinsics[view])
    return (centers[view] + rays[:, None] / inverse[:, None]).reshape(-1, 3)


def _points_of(
    scene: SparseScene, maps: DepthMaps, view: int
) -> tuple[Float[Tensor, "point view 2"], Bool[Tensor, "point view"]]:
    """Return where views show points of one depth map that another map agrees with.

    In views whose own map agrees, it says where; in others that look alike there, this map does.
    """
    valid = maps.agreed[view] > 0
    step = max(1, math.ceil(math.sqrt(int(valid.sum()) / _MOST)))
    chosen = torch.zeros_like(valid)
    chosen[step // 2 :: step, step // 2 :: step] = True
    chosen &= valid
    row, column = chosen.nonzero(as_tuple=True)
    own = torch.stack([column, row], dim=1).to(maps.inverse_depth) + 0.5
    count = scene.cameras.num_views
    pixels = own.new_zeros(len(own), count, 2)
    seen = torch.zeros(len(own), count, dtype=torch.bool, device=own.device)
    pixels[:, view], seen[:, view] = own, True
    for source in maps.sources[view][maps.sources[view] >= 0].tolist():
        pixels[:, source], seen[:, source] = _in_source(maps, view, source, chosen)
    enough = seen.sum(dim=1) >= _FEWEST_VIEWS
    return pixels[enough] * maps.factor, seen[enough]


def _in_source(
    maps: DepthMaps, view: int, source: int, chosen: Mask
) -> tuple[Pixels, Bool[Tensor, " point"]]:
    one = torch.tensor([source], device=chosen.device)
    pairing = pair(maps.level, view, one)
    field, there = maps.inverse_depth[view], maps.agreed > 0
    agrees = agreeing(maps.level, maps.inverse_depth, there, view, one)[chosen] > 0
    alike = Matcher(maps.level, pairing).scores(field, [0.0])[0, chosen] >= 0.5
    rays = pairing.replace(ray=pairing.ray[:, :, chosen])
    height, width = chosen.shape
    grid = grid_from_pixels(rays.look(field[chosen])[0].movedim(1, -1), width, height)
    depth = 1 / nearest_pixels(maps.inverse_depth[one], grid).clamp_min(1e-9)
    # Where the ray is as deep in the source as the source's own map says.
    by_source = (rays.ray[:, 2] / (depth - rays.shift[:, 2:]))[0]
    agrees = agrees & (by_source > 0)
    pixels, _ = rays.look(torch.where(agrees, by_source, field[chosen]))
    return pixels[0].mT, agrees | alike


def _with(
    scene: SparseScene, pixels: Float[Tensor, "point view 2"], seen: Bool[Tensor, "point view"]
) -> SparseScene:
    """Triangulate, and put points and tracks beside the scene's own."""
    cameras = scene.cameras
    exact = cameras.to(torch.float64)
    points = triangulate_rays(exact, pixels.double(), seen)
    expected, depth = project(points, exact.cam_from_world, exact.intrinsics)
    error = (expected.movedim(0, 1) - pixels).norm(dim=-1)
    seen = seen & (error <= _MAX_ERROR_PX) & (depth.mT > 0)
    kept = seen.sum(dim=1) >= _FEWEST_VIEWS
    leave_out("depth_points.points", ~kept, at=points)
    points, seen, error, pixels = points[kept], seen[kept], error[kept], pixels[kept]
    point, view = seen.nonzero(as_tuple=True)
    like, before = scene.points_world, len(scene.points_world)
    mean = (error * seen).sum(dim=1) / seen.sum(dim=1).clamp_min(1)
    own = photographed(scene, pixels[point, view], view)
    return scene.replace(
        points_world=torch.cat([like, points.to(like)]),
        reprojection_errors_px=torch.cat([scene.reprojection_errors_px, mean.to(like)]),
        observation_point=torch.cat([scene.observation_point, point + before]),
        observation_view=torch.cat([scene.observation_view, view]),
        observation_pixels=torch.cat([scene.observation_pixels, own.to(like)]),
    )
