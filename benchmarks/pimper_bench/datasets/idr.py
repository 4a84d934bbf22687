"""Writing of IDR and NeuS sets: ``cameras.npz``, ``image/`` and ``mask/``."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.export.picture_files import write_mask, write_picture
from pimper_torch.geometry.pixels import indices_from_pixels
from pimper_torch.geometry.projection import project
from pimper_torch.records import Cameras, Views
from pimper_torch.runtime.errors import InputError

_CAMERA_FILES = ("cameras.npz", "cameras_sphere.npz")


def write_idr(
    views: Views,
    cameras: Cameras,
    folder: Path | str,
    *,
    points_world: Float[Tensor, "point 3"] | None = None,
) -> None:
    """Write ``image/``, ``mask/`` and ``cameras.npz`` (and the same as ``cameras_sphere.npz``).

    Images are numbered in the order of the views. Views without masks get white ones, because
    programs require masks.

    Args:
        points_world: On the object: ``scale_mat`` scales them into the unit sphere. Without
            them, the sphere is estimated from masks and cameras, see :func:`unit_sphere`.
    """
    folder = Path(folder)
    digits = max(3, len(str(views.num_views - 1)))
    for index in range(views.num_views):
        write_picture(views, index, folder / "image" / f"{index:0{digits}d}.png")
        write_mask(views, index, folder / "mask" / f"{index:0{digits}d}.png")
    K = cameras.intrinsics.detach().cpu().double().clone()
    K[:, :2, 2] = indices_from_pixels(K[:, :2, 2])
    pose = cameras.cam_from_world.detach().cpu().double()
    world_mat = pose.clone()
    world_mat[:, :3] = K @ pose[:, :3]
    scale_mat = unit_sphere(cameras, points_world, views.masks)
    arrays: dict[str, np.ndarray] = {}
    for index, matrix in enumerate(world_mat):
        arrays[f"world_mat_{index}"] = matrix.numpy()
        arrays[f"scale_mat_{index}"] = scale_mat.numpy()
    for name in _CAMERA_FILES:
        np.savez(folder / name, allow_pickle=False, **arrays)


def unit_sphere(
    cameras: Cameras,
    points_world: Float[Tensor, "point 3"] | None = None,
    masks: Bool[Tensor, "view height width"] | None = None,
) -> Float[Tensor, "4 4"]:
    """Return ``world_from_unit`` of a sphere that contains the object.

    With points, it is centred on their bounding box, and the farthest point is at nine tenths of
    its radius. Without, it is centred at the point nearest to all optical axes (least squares);
    the masks extend to nine tenths of its radius in the view where they extend farthest, or
    without masks, it extends to the corners of the median image.

    Args:
        cameras: Not all of the same direction, unless points are given.
        points_world: On the object; at least two different ones.
        masks: True on the object.

    Raises:
        InputError: All points are equal, the axes are parallel, or the cameras
            look away from the centre.
    """
    if points_world is not None:
        points = points_world.detach().cpu().double()
        center = (points.amin(dim=0) + points.amax(dim=0)) / 2
        radius = float((points - center).norm(dim=-1).max()) / 0.9
    else:
        center = _fixation(cameras)
        radii = torch.tensor(
            [_extent(cameras, center, masks, v) for v in range(len(cameras.sizes_px))]
        )
        radius = float(radii.median() if masks is None else radii.max() / 0.9)
    if not radius > 0:
        raise InputError(
            "the sphere around the object has no size; needed: points on the object, or cameras "
            "that look at it from several sides."
        )
    world_from_unit = torch.eye(4, dtype=torch.float64)
    world_from_unit[:3] *= radius
    world_from_unit[:3, 3] = center
    return world_from_unit


def _fixation(cameras: Cameras) -> Float[Tensor, "3"]:
    """Return the point nearest to all optical axes."""
    axes = cameras.cam_from_world[:, 2, :3].detach().cpu().double()
    centers = cameras.centers_world.detach().cpu().double()
    # A point's squared distance from an axis is |(I - a a^T) (x - c)|^2.
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    system, constant = across.sum(dim=0), (across @ centers[..., None]).sum(dim=0)[:, 0]
    if float(torch.linalg.eigvalsh(system)[0]) < 1e-6 * len(axes):
        raise InputError(
            "the cameras all look the same way, so the object's position is undetermined; needed: "
            "points on it (a mesh), or cameras that look at it from several sides."
        )
    return torch.linalg.solve(system, constant)


def _extent(
    cameras: Cameras,
    center: Float[Tensor, "3"],
    masks: Bool[Tensor, "view height width"] | None,
    view: int,
) -> float:
    """Return how far a view's mask, or image, extends from a point, at the depth of the point."""
    pose = cameras.cam_from_world[view].detach().cpu().double()
    K = cameras.intrinsics[view].detach().cpu().double()
    width, height = (float(side) for side in cameras.sizes_px[view])
    if masks is None:
        pixels = K.new_tensor([[0, 0], [width, 0], [0, height], [width, height]])
    else:
        pixels = torch.nonzero(masks[view].cpu()).flip(-1) + 0.5
        pixels = pixels.to(K)
    projected, depth = project(center[None], pose, K)
    if not len(pixels) or float(depth) <= 0:
        return 0.0
    return float(((pixels - projected) / K.diagonal()[:2]).norm(dim=-1).max() * depth)
