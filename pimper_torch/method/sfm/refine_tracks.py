"""Tracks found again in the photographs, and cameras adjusted to them."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.ground.geometry.lens_models import distort
from pimper_torch.ground.geometry.pixels import homogeneous
from pimper_torch.ground.radiometry import SATURATED
from pimper_torch.method.sfm import track_observations as tracks
from pimper_torch.method.sfm.colmap import bundle, observation_errors
from pimper_torch.method.sfm.model import SparseModel, longest_tracks
from pimper_torch.method.sfm.reconstruct_config import MIN_POINTS
from pimper_torch.method.sfm.undistort import pinholes_for, undistorted
from pimper_torch.records import Cameras, Views, pairs_table
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.mapped import by_view

# Residual at which a track observation counts half, until the residuals determine it: then
# their spread, between bounds. Cauchy's 2.4 spreads would suit Gaussian residuals; these have long
# tails, from light that is not a slope: one spread puts points a quarter nearer to the truth.
_FIRST_SCALE_PX, _SCALES_PX = 0.5, (0.05, 1.0)

# Relative falls of the cost that end the adjustment for the spread, and the one after it.
_FIRST_TOLERANCE, _TOLERANCE = 1e-3, 1e-5


# Points a view in the rounds before the last, whose cameras are where the next one looks from. On
# 20 photographs of 640x480 with 8,900 points both rounds take 21 in place of 35 CPU s, and cameras
# put places 0.009 % of the diagonal off (0.013 % with all points); with 128 points 0.024 %. In the
# last round the number matters: 128 points a view there, 0.13 %.
_PILOTS = 256


def refine_tracks(
    views: Views, model: SparseModel, iterations: int, *, cameras: bool = True
) -> SparseModel:
    """Find the points again in every view, and adjust cameras, lenses and points to that.

    Features are found in each photograph by itself, off by half a pixel; patches are aligned
    with one another, off by less than a tenth, and in views whose features did not match. A
    point that is not found again in three views keeps its features, which then weigh little.
    Rounds before the last find a part of the points, for cameras alone.

    Args:
        cameras: Whether cameras and lenses are adjusted, too. Held fixed, one round is enough.

    Returns:
        The same views. Points that nothing agrees about are left out.
    """
    rounds = iterations if cameras else min(iterations, 1)
    gray = views.replace(images=by_view(_gray, views.images.detach()))
    for left in reversed(range(rounds)):
        some = longest_tracks(model, _PILOTS) if left else model
        renewed, aligned = _renewed(gray, some)
        if not bool(aligned.any()):
            return model
        tied, leading, scale = _adjusted(renewed, aligned, cameras=cameras)
        model = model if left else renewed
        model = model.replace(lenses=tied.lenses, cam_from_world=tied.cam_from_world)
        if left:
            model = bundle(model, _FIRST_SCALE_PX, cameras=False, tolerance=_FIRST_TOLERANCE)
            continue
        points = model.points_world.clone()
        points[leading] = tied.points_world
        if not bool(leading.all()):
            others = model.without(leading[model.observation_point])
            others = bundle(others, _FIRST_SCALE_PX, cameras=False, tolerance=_FIRST_TOLERANCE)
            others = bundle(others, scale, cameras=False, tolerance=_TOLERANCE)
            points[~leading] = others.points_world
        model = model.replace(points_world=points)
    if rounds:
        limit = torch.where(aligned, 10 * scale, 2.0)  # features are less exact
        before = len(model.points_world)
        model = model.without(observation_errors(model) > limit)
        leave_out("sfm.tracks", before - len(model.points_world), total=before)
    return model


def found_again(views: Views, model: SparseModel) -> SparseModel:
    """Find the points in every view; observations by features, and points of two views, go.

    Poses, lenses and places of points are as they were.
    """
    gray = views.replace(images=by_view(_gray, views.images.detach()))
    renewed, aligned = _renewed(gray, model)
    return renewed.without(~aligned)


def _gray(image: Float[Tensor, "channel height width"]) -> Float[Tensor, "1 height width"]:
    """Average colours; what is saturated in one stays so."""
    brightest = image.amax(dim=0, keepdim=True)
    return torch.where(brightest >= SATURATED, brightest, image.mean(dim=0, keepdim=True))


def _renewed(views: Views, model: SparseModel) -> tuple[SparseModel, Bool[Tensor, " observation"]]:
    """Replace features by track observations, and find which observations are such."""
    raster = (views.num_views, *views.images.shape[-2:])
    pictures = tracks.log_pictures(undistorted(views, model.lenses), raster)
    cameras = Cameras(
        intrinsics=pinholes_for(model.lenses),
        cam_from_world=model.cam_from_world,
        sizes_px=views.sizes_px.cpu(),
    )
    planes = tracks.tangents(model.points_world, model.observed, cameras)
    found = tracks.observe_points(pictures, cameras, planes)
    del pictures  # as large as the photographs
    often = torch.bincount(found.point, minlength=len(model.points_world)) >= 3
    kept = often[found.point]
    point, view = found.point[kept], found.view[kept]
    ends = homogeneous(found.pixels[kept])
    pixels = torch.empty_like(ends[:, :2])
    for index, lens in enumerate(model.lenses):
        here = view == index
        rays = torch.linalg.solve(cameras.intrinsics[index], ends[here].mT).mT
        pixels[here] = distort(lens, rays)
    poor = torch.bincount(view, minlength=model.num_views) < MIN_POINTS
    seen = pairs_table(point, view, (len(often), model.num_views))
    theirs = model.observation_point, model.observation_view
    feature = (~often[theirs[0]] | poor[theirs[1]]) & ~seen[theirs]
    point = torch.cat([point, theirs[0][feature]])
    view = torch.cat([view, theirs[1][feature]])
    pixels = torch.cat([pixels, model.observation_pixels[feature]])
    order = torch.argsort(point * model.num_views + view)
    renewed = model.replace(
        observation_point=point[order],
        observation_view=view[order],
        observation_pixels=pixels[order],
    )
    return renewed, order < int(kept.sum())


def _adjusted(
    model: SparseModel, aligned: Bool[Tensor, " observation"], *, cameras: bool
) -> tuple[SparseModel, Bool[Tensor, " point"], float]:
    """Adjust points and cameras, unless held fixed, to aligned observations.

    Returns:
        The model of the leading points, which points these are, and the scale of the residuals.
    """
    # Points that are aligned lead, and all points of views that show few of those.
    counts = torch.bincount(model.observation_view[aligned], minlength=model.num_views)
    weighty = aligned | (counts < MIN_POINTS)[model.observation_view]
    points = torch.bincount(model.observation_point[weighty], minlength=len(model.points_world)) > 0
    leading = points[model.observation_point]
    tied = model.without(~leading)
    tied = bundle(tied, _FIRST_SCALE_PX, cameras=cameras, tolerance=_FIRST_TOLERANCE)
    # The median length of a two-dimensional Gaussian's draws is 1.1774 standard deviations.
    spread = float(observation_errors(tied)[aligned[leading]].median()) / 1.1774
    scale = min(max(spread, _SCALES_PX[0]), _SCALES_PX[1])
    return bundle(tied, scale, cameras=cameras, tolerance=_TOLERANCE), points, scale
