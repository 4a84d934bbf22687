"""Lenses as COLMAP's camera models have them."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.ground.geometry.colmap_library import loaded
from pimper_torch.ground.geometry.pixels import homogeneous
from pimper_torch.ground.shapes import Matrix3
from pimper_torch.records import CameraModel, Cameras, SparseScene


def pinhole_of(lens: CameraModel) -> Matrix3:
    """Return ``K`` with the lens's focal length and principal point, in float64."""
    return torch.from_numpy(np.array(camera_of(lens).calibration_matrix(), dtype=np.float64))


def is_pinhole(lens: CameraModel) -> bool:
    """Return whether the lens images straight lines as straight lines.

    COLMAP calls a lens undistorted whose coefficients are all zero; of a fisheye that is the
    equidistant one, ``r = f theta``.
    """
    return "FISHEYE" not in lens.model and bool(camera_of(lens).is_undistorted())


def distort(lens: CameraModel, rays_cam: Float[Tensor, "ray 3"]) -> Float[Tensor, "ray 2"]:
    """Find where the lens images directions, in pixels of the photograph.

    Args:
        rays_cam: Camera frame, any length.

    Returns:
        NaN for directions that the lens cannot image. A constant to autograd.
    """
    rays = np.ascontiguousarray(rays_cam.detach().cpu().double().numpy())
    pixels = np.array(camera_of(lens).img_from_cam(rays), dtype=np.float64).reshape(-1, 2)
    return torch.from_numpy(pixels).to(rays_cam)


def undistort_pixels(
    lens: CameraModel, pixels: Float[Tensor, "pixel 2"]
) -> Float[Tensor, "pixel 2"]:
    """Return ``(x, y)`` of the direction ``(x, y, 1)`` behind each pixel, as :func:`distort`."""
    columns = np.ascontiguousarray(pixels.detach().cpu().double().numpy())
    found = np.array(camera_of(lens).cam_from_img(columns), dtype=np.float64).reshape(-1, 2)
    return torch.from_numpy(found).to(pixels)


def rescale_lens(lens: CameraModel, width: int, height: int) -> CameraModel:
    """Follow a resize of the photograph."""
    camera = camera_of(lens)
    camera.rescale(width, height)
    return lens_of(camera)


def camera_of(lens: CameraModel) -> Any:  # noqa: ANN401 - pycolmap has no types before it is loaded
    """Return a lens as COLMAP has it."""
    pycolmap = loaded()
    camera = pycolmap.Camera.create_from_model_name(
        lens.camera, lens.model, 1.0, lens.width, lens.height
    )
    camera.params = np.array(lens.params)
    return camera


def pinhole_lenses(cameras: Cameras) -> tuple[CameraModel, ...]:
    """Assign every view its pinhole; views with equal ones share a camera."""
    numbers: dict[tuple[float, ...], int] = {}
    lenses = []
    for K, (width, height) in zip(
        cameras.intrinsics.detach().cpu().double(), cameras.sizes_px.tolist(), strict=True
    ):
        params = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
        camera = numbers.setdefault((*params, width, height), len(numbers) + 1)
        lenses.append(
            CameraModel(camera=camera, model="PINHOLE", params=params, width=width, height=height)
        )
    return tuple(lenses)


def photographed(
    scene: SparseScene, pixels: Float[Tensor, "pixel 2"], view: Int[Tensor, " pixel"]
) -> Float[Tensor, "pixel 2"]:
    """Return where the photographs, before undistortion, have pixels of the undistorted ones."""
    found = pixels.clone()
    pinholes = pinhole_lenses(scene.cameras)
    for index, (own, pinhole) in enumerate(zip(scene.lenses, pinholes, strict=True)):
        if own.replace(camera=pinhole.camera) != pinhole:
            here = view == index
            ends = homogeneous(undistort_pixels(pinhole, pixels[here]))
            found[here] = distort(own, ends)
    return found


def lens_of(camera: Any) -> CameraModel:  # noqa: ANN401 - see camera_of
    """Return a lens of COLMAP's as a record."""
    return CameraModel(
        camera=int(camera.camera_id),
        model=str(camera.model_name),
        params=tuple(float(value) for value in camera.params),
        width=int(camera.width),
        height=int(camera.height),
    )
