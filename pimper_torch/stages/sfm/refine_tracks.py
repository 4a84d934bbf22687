"""Refinement of tracks by aligning patches, and of cameras by bundle adjustment."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.geometry.lens_models import distort
from pimper_torch.geometry.pixels import homogeneous
from pimper_torch.geometry.undistortion import pinholes_for, undistorted
from pimper_torch.radiometry import SATURATED
from pimper_torch.records import Cameras, Views, pairs_table
from pimper_torch.records.sparse_model import SparseModel, longest_tracks
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.mapped import by_view
from pimper_torch.stages.sfm import track_observations as tracks
from pimper_torch.stages.sfm.colmap import bundle, observation_errors
from pimper_torch.stages.sfm.reconstruct_config import MIN_POINTS

# Residual at which a track observation has half weight: first a fixed one, then the residuals'
# spread, between bounds. Cauchy's 2.4 spreads would suit Gaussian residuals; these have long tails,
# from light that is not linear over a patch: one spread puts points a quarter closer to the truth.
_FIRST_SCALE_PX, _SCALES_PX = 0.5, (0.05, 1.0)

# Relative decreases of the cost that end the adjustment for the spread, and the final one.
_FIRST_TOLERANCE, _TOLERANCE = 1e-3, 1e-5


# Points per view in the rounds before the last one, whose cameras only begin the next. On 20
# photographs of 640x480 with 8,900 points, two rounds take 21 instead of 35 CPU s, and positions by
# the cameras are 0.009 % of the diagonal off (0.013 % with all points); with 128 points 0.024 %. In
# the last round the number matters: with 128 points per view there, 0.13 %.
_PILOTS = 256


def refine_tracks(
    views: Views, model: SparseModel, iterations: int, *, cameras: bool = True
) -> SparseModel:
    """Refine the points' pixels in every view, and adjust cameras, lenses and points to them.

    Features are detected in each photograph separately, with errors of half a pixel. Aligned
    patches have errors below a tenth, also in views without matched features. A point that is not
    aligned in three views keeps its features, with little weight. Rounds before the last one align
    only some of the points, for the cameras.

    Args:
        cameras: Whether cameras and lenses are adjusted. Held fixed, one round is enough.

    Returns:
        The same views. Points without consistent observations are removed.
    """
    rounds = iterations if cameras else min(iterations, 1)
    gray = views.replace(images=by_view(_gray, views.images.detach()))
    for remaining in reversed(range(rounds)):
        selected = longest_tracks(model, _PILOTS) if remaining else model
        renewed, aligned = _align(gray, selected)
        if not bool(aligned.any()):
            return model
        adjusted, is_leading, scale = _adjust(renewed, aligned, cameras=cameras)
        model = model if remaining else renewed
        model = model.replace(lenses=adjusted.lenses, cam_from_world=adjusted.cam_from_world)
        if remaining:
            model = bundle(model, _FIRST_SCALE_PX, cameras=False, tolerance=_FIRST_TOLERANCE)
            continue
        points = model.points_world.clone()
        points[is_leading] = adjusted.points_world
        if not bool(is_leading.all()):
            others = model.without(is_leading[model.observation_point])
            others = bundle(others, _FIRST_SCALE_PX, cameras=False, tolerance=_FIRST_TOLERANCE)
            others = bundle(others, scale, cameras=False, tolerance=_TOLERANCE)
            points[~is_leading] = others.points_world
        model = model.replace(points_world=points)
    if rounds:
        limit = torch.where(aligned, 10 * scale, 2.0)  # features are less exact
        count = len(model.points_world)
        model = model.without(observation_errors(model) > limit)
        leave_out("sfm.tracks", count - len(model.points_world), total=count)
    return model


def align_tracks(views: Views, model: SparseModel) -> SparseModel:
    """Align the points in every view; remove other observations, and points of under three views.

    Poses, lenses and positions of points are unchanged.
    """
    gray = views.replace(images=by_view(_gray, views.images.detach()))
    renewed, aligned = _align(gray, model)
    return renewed.without(~aligned)


def _gray(image: Float[Tensor, "channel height width"]) -> Float[Tensor, "1 height width"]:
    """Return the mean over channels; pixels saturated in one channel stay saturated."""
    brightest = image.amax(dim=0, keepdim=True)
    return torch.where(brightest >= SATURATED, brightest, image.mean(dim=0, keepdim=True))


def _align(views: Views, model: SparseModel) -> tuple[SparseModel, Bool[Tensor, " observation"]]:
    """Replace features by aligned observations; also return which observations are aligned."""
    raster = (views.num_views, *views.images.shape[-2:])
    pictures = tracks.log_pictures(undistorted(views, model.lenses), raster)
    cameras = Cameras(
        intrinsics=pinholes_for(model.lenses),
        cam_from_world=model.cam_from_world,
        sizes_px=views.sizes_px.cpu(),
    )
    planes = tracks.tangent_planes(model.points_world, model.observed, cameras)
    aligned = tracks.observe_points(pictures, cameras, planes)
    del pictures  # as large as the photographs
    often = torch.bincount(aligned.point, minlength=len(model.points_world)) >= 3
    kept = often[aligned.point]
    point, view = aligned.point[kept], aligned.view[kept]
    ends = homogeneous(aligned.pixels[kept])
    pixels = torch.empty_like(ends[:, :2])
    for index, lens in enumerate(model.lenses):
        in_view = view == index
        rays = torch.linalg.solve(cameras.intrinsics[index], ends[in_view].mT).mT
        pixels[in_view] = distort(lens, rays)
    has_few = torch.bincount(view, minlength=model.num_views) < MIN_POINTS
    is_aligned = pairs_table(point, view, (len(often), model.num_views))
    old = model.observation_point, model.observation_view
    feature = (~often[old[0]] | has_few[old[1]]) & ~is_aligned[old]
    point = torch.cat([point, old[0][feature]])
    view = torch.cat([view, old[1][feature]])
    pixels = torch.cat([pixels, model.observation_pixels[feature]])
    order = torch.argsort(point * model.num_views + view)
    renewed = model.replace(
        observation_point=point[order],
        observation_view=view[order],
        observation_pixels=pixels[order],
    )
    return renewed, order < int(kept.sum())


def _adjust(
    model: SparseModel, aligned: Bool[Tensor, " observation"], *, cameras: bool
) -> tuple[SparseModel, Bool[Tensor, " point"], float]:
    """Adjust points and cameras, unless held fixed, to aligned observations.

    Returns:
        The model of the leading points, which points these are, and the scale of the residuals.
    """
    # Leading are aligned points, and all points of views with few of these.
    counts = torch.bincount(model.observation_view[aligned], minlength=model.num_views)
    is_used = aligned | (counts < MIN_POINTS)[model.observation_view]
    points = torch.bincount(model.observation_point[is_used], minlength=len(model.points_world)) > 0
    leading = points[model.observation_point]
    lead = model.without(~leading)
    lead = bundle(lead, _FIRST_SCALE_PX, cameras=cameras, tolerance=_FIRST_TOLERANCE)
    # The median length of a two-dimensional Gaussian's draws is 1.1774 standard deviations.
    spread = float(observation_errors(lead)[aligned[leading]].median()) / 1.1774
    scale = min(max(spread, _SCALES_PX[0]), _SCALES_PX[1])
    return bundle(lead, scale, cameras=cameras, tolerance=_TOLERANCE), points, scale
