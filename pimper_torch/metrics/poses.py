"""How far the cameras of an estimate are from the true ones."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.geometry.frames import transform
from pimper_torch.metrics.similarity import rotation_angles_deg, split_similarity
from pimper_torch.records import Cameras, Record


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFigures(Record):
    """Errors of cameras, over the views that have one in both.

    Attributes:
        views: How many photographs there are in the truth.
        missing: How many of them the estimate has no camera for.
        mean_rotation_deg: Angle between the cameras.
        median_rotation_deg: The same.
        mean_center: Distance between the cameras' places, scene units of the truth.
        median_center: The same.
        mean_center_percent: Of each true camera's distance from the object's middle; NaN
            where nobody knows the object.
        mean_center_percent_of_diagonal: Of the object's bounding box; NaN the same.
        mean_focal_percent: Of the focal length, absolute; images of unlike size are taken
            for resized ones.
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


def compare_cameras(
    ours: Cameras,
    truth: Cameras,
    truth_from_world: Float[Tensor, "4 4"],
    *,
    views: int,
    middle: Float[Tensor, " 3"] | None = None,
    diagonal: float | None = None,
) -> CameraFigures:
    """Compare cameras after a similarity carried ours to the frame of the truth.

    Args:
        ours: World frame of the estimate.
        truth: The same views in the same order.
        truth_from_world: Similarity; on these cameras, for the usual figure.
        views: How many photographs there are in all.
        middle: Of the object, frame of the truth.
        diagonal: Of the object's bounding box.
    """
    truth_from_ours = truth_from_world.double().cpu()
    _, rotation = split_similarity(truth_from_ours)
    turned = ours.cam_from_world[:, :3, :3].double().cpu() @ rotation.mT
    centers = transform(truth_from_ours, ours.centers_world.double().cpu())
    centers_true = truth.centers_world.double().cpu()
    between = truth.cam_from_world[:, :3, :3].double().cpu() @ turned.mT
    angles = rotation_angles_deg(between)
    offset = (centers - centers_true).norm(dim=1)
    away = torch.full_like(offset, torch.nan)
    if middle is not None:
        away = (centers_true - middle.to(centers_true)).norm(dim=1)
    focal = _focal(ours) / _focal(truth) - 1
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
    )


def _focal(cameras: Cameras) -> Float[Tensor, " view"]:
    """Give the mean focal length in units of the image's longer side."""
    both = cameras.intrinsics.double().cpu().diagonal(dim1=-2, dim2=-1)[:, :2]
    return both.mean(dim=1) / cameras.sizes_px.cpu().amax(dim=1)
