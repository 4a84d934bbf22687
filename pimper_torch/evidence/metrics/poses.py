"""How far the cameras of an estimate are from the true ones."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.evidence.metrics.similarity import (
    rotation_angles_deg,
    similarity_between_points,
    split_similarity,
)
from pimper_torch.geometry.frames import transform
from pimper_torch.geometry.projection import project, triangulate_rays
from pimper_torch.records import Cameras, Record

# Rays that make a point, and points that make a figure.
_FEWEST_RAYS, _FEWEST_PLACES = 3, 10


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFigures(Record):
    """Errors of cameras, over the views that have one in both.

    Attributes:
        views: How many photographs there are in the truth.
        missing: How many of them the estimate has no camera for.
        mean_center: Distance between the cameras' positions, scene units of the truth.
        mean_center_percent: Of each true camera's distance from the object's centre; NaN
            where the object is unknown.
        mean_center_percent_of_diagonal: Of the object's bounding box; NaN the same.
        mean_focal_percent: Of the focal length, absolute; images of unlike size are taken
            for resized ones.
        mean_position_percent: How far off the object's points are put when each is where our
            cameras' rays through its true pixels meet, of the diagonal: no surface made with
            these cameras is nearer, but by chance. NaN where the object is unknown.
        mean_bend_percent: The same once the points themselves were brought together: what
            another alignment cannot repair.
    """

    views: int
    missing: int
    mean_rotation_deg: float
    median_rotation_deg: float
    mean_center: float
    median_center: float
    mean_center_percent: float
    mean_center_percent_of_diagonal: float
    mean_focal_percent: float
    mean_position_percent: float = math.nan
    mean_bend_percent: float = math.nan


def compare_cameras(
    ours: Cameras,
    truth: Cameras,
    truth_from_world: Float[Tensor, "4 4"],
    *,
    views: int,
    centre: Float[Tensor, " 3"] | None = None,
    diagonal: float | None = None,
    points_true: Float[Tensor, "point 3"] | None = None,
) -> CameraFigures:
    """Compare cameras after a similarity carried ours to the frame of the truth.

    Args:
        ours: World frame of the estimate.
        truth: The same views in the same order.
        truth_from_world: Similarity; on these cameras, for the usual figure.
        views: How many photographs there are in all.
        centre: Of the object, frame of the truth.
        diagonal: Of the object's bounding box.
    """
    truth_from_ours = truth_from_world.double().cpu()
    _, rotation = split_similarity(truth_from_ours)
    rotated = ours.cam_from_world[:, :3, :3].double().cpu() @ rotation.mT
    centers = transform(truth_from_ours, ours.centers_world.double().cpu())
    centers_true = truth.centers_world.double().cpu()
    between = truth.cam_from_world[:, :3, :3].double().cpu() @ rotated.mT
    angles = rotation_angles_deg(between)
    offset = (centers - centers_true).norm(dim=1)
    away = torch.full_like(offset, torch.nan)
    if centre is not None:
        away = (centers_true - centre.to(centers_true)).norm(dim=1)
    focal = _focal(ours) / _focal(truth) - 1
    position, bend = math.nan, math.nan
    if points_true is not None and diagonal:
        found, right = _positions(ours, truth, points_true.double().cpu())
        if len(found) >= _FEWEST_PLACES:
            fitted = similarity_between_points(found, right)
            position, bend = (
                float(100 * (transform(transferred, found) - right).norm(dim=1).mean() / diagonal)
                for transferred in (truth_from_ours, fitted)
            )
    return CameraFigures(
        views=views,
        missing=views - ours.num_views,
        mean_rotation_deg=float(angles.mean()),
        median_rotation_deg=float(angles.median()),
        mean_center=float(offset.mean()),
        median_center=float(offset.median()),
        mean_center_percent=float((100 * offset / away).mean()),
        mean_center_percent_of_diagonal=float(100 * offset.mean() / (diagonal or torch.nan)),
        mean_focal_percent=float(100 * focal.abs().mean()),
        mean_position_percent=position,
        mean_bend_percent=bend,
    )


def _positions(
    ours: Cameras, truth: Cameras, points_true: Float[Tensor, "point 3"]
) -> tuple[Float[Tensor, "position 3"], Float[Tensor, "position 3"]]:
    """Return where our cameras put points that the true ones have in their images, and these."""
    pixels, depth = project(
        points_true, truth.cam_from_world.double().cpu(), truth.intrinsics.double().cpu()
    )
    sizes = truth.sizes_px[:, None].cpu()
    seen = ((pixels > 0) & (pixels < sizes)).all(dim=-1) & (depth > 0)
    often = seen.sum(dim=0) >= _FEWEST_RAYS
    resized = ours.sizes_px[:, None].cpu().double() / sizes
    cameras = ours.replace(
        intrinsics=ours.intrinsics.double().cpu(),
        cam_from_world=ours.cam_from_world.double().cpu(),
        sizes_px=ours.sizes_px.cpu(),
    )
    pixels = (pixels * resized)[:, often].movedim(0, 1)
    return triangulate_rays(cameras, pixels, seen[:, often].mT), points_true[often]


def _focal(cameras: Cameras) -> Float[Tensor, " view"]:
    """Return the mean focal length in units of the image's longer side."""
    both = cameras.intrinsics.double().cpu().diagonal(dim1=-2, dim2=-1)[:, :2]
    return both.mean(dim=1) / cameras.sizes_px.cpu().amax(dim=1)
