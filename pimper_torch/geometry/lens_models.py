"""Projection, distortion and conversion of COLMAP's camera models."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.geometry.colmap_library import loaded
from pimper_torch.geometry.pixels import homogeneous
from pimper_torch.records import CameraModel, Cameras, SparseScene
from pimper_torch.records.shapes import Matrix3
from pimper_torch.records.sparse_model import SparseModel


def pinhole_of(lens: CameraModel) -> Matrix3:
    """Return ``K`` with the focal lengths and principal point of a camera model, in float64."""
    return torch.from_numpy(np.array(camera_of(lens).calibration_matrix(), dtype=np.float64))


def is_pinhole(lens: CameraModel) -> bool:
    """Return whether the lens images straight lines as straight lines.

    COLMAP calls a lens undistorted if its coefficients are all zero; for a fisheye this is the
    equidistant projection, ``r = f theta``.
    """
    return "FISHEYE" not in lens.model and bool(camera_of(lens).is_undistorted())


def distort(lens: CameraModel, rays_cam: Float[Tensor, "ray 3"]) -> Float[Tensor, "ray 2"]:
    """Project directions through the lens to pixels of the photograph.

    Args:
        rays_cam: Camera frame, any length.

    Returns:
        NaN for directions that the lens cannot image. Not differentiable.
    """
    rays = np.ascontiguousarray(rays_cam.detach().cpu().double().numpy())
    pixels = np.array(camera_of(lens).img_from_cam(rays), dtype=np.float64).reshape(-1, 2)
    return torch.from_numpy(pixels).to(rays_cam)


def undistort_pixels(
    lens: CameraModel, pixels: Float[Tensor, "pixel 2"]
) -> Float[Tensor, "pixel 2"]:
    """Return ``(x, y)`` of each pixel's direction ``(x, y, 1)``; inverse of :func:`distort`."""
    points = np.ascontiguousarray(pixels.detach().cpu().double().numpy())
    rays = np.array(camera_of(lens).cam_from_img(points), dtype=np.float64).reshape(-1, 2)
    return torch.from_numpy(rays).to(pixels)


def rescale_lens(lens: CameraModel, width: int, height: int) -> CameraModel:
    """Return the camera model of a resized photograph."""
    camera = camera_of(lens)
    camera.rescale(width, height)
    return lens_of(camera)


def camera_of(lens: CameraModel) -> Any:  # noqa: ANN401 - pycolmap has no types before it is loaded
    """Return the COLMAP camera of a camera model."""
    pycolmap = loaded()
    camera = pycolmap.Camera.create_from_model_name(
        lens.camera, lens.model, 1.0, lens.width, lens.height
    )
    camera.params = np.array(lens.params)
    return camera


def pinhole_lenses(cameras: Cameras) -> tuple[CameraModel, ...]:
    """Return the pinhole camera model of every view; views with equal ones share a camera."""
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
    """Map pixels of the undistorted photographs to those of the original ones."""
    result = pixels.clone()
    pinholes = pinhole_lenses(scene.cameras)
    for index, (lens, pinhole) in enumerate(zip(scene.lenses, pinholes, strict=True)):
        if lens.replace(camera=pinhole.camera) != pinhole:
            in_view = view == index
            rays = homogeneous(undistort_pixels(pinhole, pixels[in_view]))
            result[in_view] = distort(lens, rays)
    return result


def lens_of(camera: Any) -> CameraModel:  # noqa: ANN401 - see camera_of
    """Return the camera model of a COLMAP camera."""
    return CameraModel(
        camera=int(camera.camera_id),
        model=str(camera.model_name),
        params=tuple(float(value) for value in camera.params),
        width=int(camera.width),
        height=int(camera.height),
    )


def pinholes_of(model: SparseModel) -> Cameras:
    """Return the pinhole cameras of a model, without the distortion of its lenses."""
    return Cameras(
        intrinsics=torch.stack([pinhole_of(lens) for lens in model.lenses]),
        cam_from_world=model.cam_from_world,
        sizes_px=torch.tensor([[lens.width, lens.height] for lens in model.lenses]),
    )
