"""Errors of the cameras and lights of an estimate."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_bench.metrics import similarity
from pimper_bench.metrics.in_view import angles_deg
from pimper_bench.metrics.surface_distances import bounding_diagonal
from pimper_torch.geometry.projection import project, triangulate_rays
from pimper_torch.geometry.rigid import transform
from pimper_torch.records import Cameras, Mesh, Record


@dataclass(frozen=True, slots=True, kw_only=True)
class LightFigures(Record):
    """Angles between the directions of common lights, in degrees.

    Attributes:
        mean_deg: In the frame of the truth, after alignment of the estimate.
        mean_rotated_deg: After the one rotation of all lights that fits best.
    """

    mean_deg: float
    median_deg: float
    mean_rotated_deg: float
    median_rotated_deg: float
    rotation_deg: float
    lights: int


def compare_lights(
    lights: Float[Tensor, "view 4"],
    lights_true: Float[Tensor, "view 4"],
    rotation: Float[Tensor, "3 3"],
) -> LightFigures | None:
    """Compare the directions of first-order lights, as given and up to a rotation.

    Uncalibrated methods leave a common rotation of all lights and normals undetermined. The
    rotation minimises the summed squared distances between unit directions. With two lights or
    fewer, or lights in a plane with the origin, it overfits.

    Args:
        lights: World frame of the estimate; rows that are zero or not finite are unknown.
        rotation: From the estimate's frame to that of the truth.

    Returns:
        ``None`` if no view has a direction in both.

    Source: Kabsch, Acta Crystallographica A32(5), 1976.
    """
    ours = lights[:, 1:].cpu().double() @ rotation.cpu().double().mT
    truth = lights_true[:, 1:].cpu().double()
    valid = (ours.norm(dim=1) > 0) & (truth.norm(dim=1) > 0)
    valid &= ours.isfinite().all(dim=1) & truth.isfinite().all(dim=1)
    if not bool(valid.any()):
        return None
    ours, truth = normalize(ours[valid], dim=1), normalize(truth[valid], dim=1)
    joint = similarity.nearest_rotation(truth.mT @ ours)
    plain, rotated = angles_deg(ours, truth), angles_deg(ours @ joint.mT, truth)
    return LightFigures(
        mean_deg=float(plain.mean()),
        median_deg=float(plain.median()),
        mean_rotated_deg=float(rotated.mean()),
        median_rotated_deg=float(rotated.median()),
        rotation_deg=float(similarity.rotation_angles_deg(joint)),
        lights=int(valid.sum()),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFigures(Record):
    """Errors of cameras, over the common views.

    Attributes:
        views: Number of photographs in the truth.
        missing: Number of photographs without a camera in the estimate.
        mean_center: Distance between the cameras' positions, scene units of the truth.
        mean_center_percent: Of each true camera's distance from the object's centre; NaN
            if the object is unknown.
        mean_focal_percent: Absolute error of the focal length.
        mean_position_percent: Distance of the object's points from the intersections of the
            estimated cameras' rays through their true pixels, of the diagonal: a lower bound for
            surfaces made with these cameras. NaN if the object is unknown.
        mean_bend_percent: The same after a similarity between the points.
    """

    views: int
    missing: int
    mean_rotation_deg: float
    median_rotation_deg: float
    mean_center: float
    median_center: float
    mean_center_percent: float
    mean_focal_percent: float
    mean_position_percent: float = math.nan
    mean_bend_percent: float = math.nan


def compare_cameras(
    ours: Cameras,
    truth: Cameras,
    truth_from_world: Float[Tensor, "4 4"],
    *,
    views: int,
    surface: Mesh | None = None,
) -> CameraFigures:
    """Compare cameras after transforming the estimate to the frame of the truth.

    Args:
        truth: The same views in the same order.
        truth_from_world: Similarity; by convention that between these cameras.
        views: Number of all photographs.
        surface: The true one; of a point cloud, only the vertices are used.
    """
    truth_from_ours = truth_from_world.double().cpu()
    _, rotation = similarity.split_similarity(truth_from_ours)
    rotated = ours.cam_from_world[:, :3, :3].double().cpu() @ rotation.mT
    centers = transform(truth_from_ours, ours.centers_world.double().cpu())
    centers_true = truth.centers_world.double().cpu()
    between = truth.cam_from_world[:, :3, :3].double().cpu() @ rotated.mT
    angles = similarity.rotation_angles_deg(between)
    offset = (centers - centers_true).norm(dim=1)
    away, diagonal = torch.full_like(offset, torch.nan), math.nan
    focal = _focal(ours) / _focal(truth) - 1
    position, bend = math.nan, math.nan
    if surface is not None:
        corners = surface.vertices_world.double().cpu()
        centre = (corners.amin(dim=0) + corners.amax(dim=0)) / 2
        away, diagonal = (centers_true - centre).norm(dim=1), bounding_diagonal(surface)
        points, points_true = _positions(ours, truth, corners[:: max(1, len(corners) // 2000)])
        if len(points) >= 10:
            fitted = similarity.similarity_between_points(points, points_true)
            position, bend = (
                float(100 * (transform(moving, points) - points_true).norm(dim=1).mean() / diagonal)
                for moving in (truth_from_ours, fitted)
            )
    return CameraFigures(
        views=views,
        missing=views - ours.num_views,
        mean_rotation_deg=float(angles.mean()),
        median_rotation_deg=float(angles.median()),
        mean_center=float(offset.mean()),
        median_center=float(offset.median()),
        mean_center_percent=float((100 * offset / away).mean()),
        mean_focal_percent=float(100 * focal.abs().mean()),
        mean_position_percent=position,
        mean_bend_percent=bend,
    )


def _positions(
    ours: Cameras, truth: Cameras, points_true: Float[Tensor, "point 3"]
) -> tuple[Float[Tensor, "position 3"], Float[Tensor, "position 3"]]:
    """Return points triangulated by our cameras from their true pixels, and the true points."""
    pixels, depth = project(
        points_true, truth.cam_from_world.double().cpu(), truth.intrinsics.double().cpu()
    )
    sizes = truth.sizes_px[:, None].cpu()
    seen = ((pixels > 0) & (pixels < sizes)).all(dim=-1) & (depth > 0)
    observed = seen.sum(dim=0) >= 3
    resized = ours.sizes_px[:, None].cpu().double() / sizes
    cameras = ours.replace(
        intrinsics=ours.intrinsics.double().cpu(),
        cam_from_world=ours.cam_from_world.double().cpu(),
        sizes_px=ours.sizes_px.cpu(),
    )
    pixels = (pixels * resized)[:, observed].movedim(0, 1)
    return triangulate_rays(cameras, pixels, seen[:, observed].mT), points_true[observed]


def _focal(cameras: Cameras) -> Float[Tensor, " view"]:
    """Return the mean of both focal lengths in units of the image's longer side."""
    focal = cameras.intrinsics.double().cpu().diagonal(dim1=-2, dim2=-1)[:, :2]
    return focal.mean(dim=1) / cameras.sizes_px.cpu().amax(dim=1)
