"""Conversion to and from COLMAP models, reprojection errors, and bundle adjustment."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from pimper_torch.geometry.colmap_library import loaded, quiet
from pimper_torch.geometry.lens_models import camera_of, distort, lens_of
from pimper_torch.geometry.rigid import rigid, transform
from pimper_torch.records.sparse_model import SparseModel
from pimper_torch.runtime.errors import OutputError


def write_binary(model: SparseModel, colors: UInt8[Tensor, "point 3"], folder: Path) -> None:
    """Write a model as COLMAP's binary files.

    Args:
        folder: Created if needed; files of the same names are replaced.
    """
    with quiet():
        reconstruction = reconstruction_of(model, colors)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            reconstruction.write_binary(str(folder))
        except (ValueError, RuntimeError, OSError) as error:
            reason = f" ({error.strerror})" if isinstance(error, OSError) else ""
            raise OutputError(
                f"The sparse model cannot be written to {folder}{reason}. Choose a folder that "
                "exists and is writable."
            ) from error


def model_of(reconstruction: Any) -> SparseModel:  # noqa: ANN401 - see camera_of
    """Convert COLMAP's own model; views and points are sorted by their ids."""
    image_ids = sorted(reconstruction.reg_image_ids())
    view_of = {image_id: index for index, image_id in enumerate(image_ids)}
    images = [reconstruction.image(image_id) for image_id in image_ids]
    pixels = {
        image_id: [point.xy for point in image.points2D]
        for image_id, image in zip(image_ids, images, strict=True)
    }
    points, tracks, centers = [], [], []
    for index, point_id in enumerate(sorted(reconstruction.point3D_ids())):
        point = reconstruction.point3D(point_id)
        points.append(point.xyz)
        for element in point.track.elements:
            tracks.append((index, view_of[element.image_id]))
            centers.append(pixels[element.image_id][element.point2D_idx])
    track = torch.tensor(tracks, dtype=torch.long).reshape(-1, 2)
    matrices = np.array([image.cam_from_world().matrix() for image in images]).reshape(-1, 3, 4)
    poses = torch.from_numpy(matrices)
    return SparseModel(
        names=tuple(image.name for image in images),
        lenses=tuple(lens_of(reconstruction.camera(image.camera_id)) for image in images),
        cam_from_world=rigid(poses[..., :3], poses[..., 3]),
        points_world=torch.from_numpy(np.array(points, dtype=np.float64).reshape(-1, 3)),
        observation_point=track[:, 0],
        observation_view=track[:, 1],
        observation_pixels=torch.from_numpy(np.array(centers, dtype=np.float64).reshape(-1, 2)),
    )


def reconstruction_of(model: SparseModel, colors: UInt8[Tensor, "point 3"] | None = None) -> Any:  # noqa: ANN401 - see camera_of
    """Convert to COLMAP's own model; its ids keep the order of views and points."""
    pycolmap = loaded()

    reconstruction = pycolmap.Reconstruction()
    for lens in {lens.camera: lens for lens in model.lenses}.values():
        reconstruction.add_camera_with_trivial_rig(camera_of(lens))
    view, pixels = model.observation_view.numpy(), model.observation_pixels.numpy()
    position = np.empty(len(view), dtype=np.int64)  # of each observation in its image
    for index, (name, lens) in enumerate(zip(model.names, model.lenses, strict=True)):
        in_view = np.flatnonzero(view == index)
        position[in_view] = np.arange(len(in_view))
        image = pycolmap.Image(
            name=name, keypoints=pixels[in_view], camera_id=lens.camera, image_id=index + 1
        )
        pose = pycolmap.Rigid3d(model.cam_from_world[index, :3].numpy())
        reconstruction.add_image_with_trivial_frame(image, pose)
    tracks = [pycolmap.Track() for _ in model.points_world]
    ends = (model.observation_point.tolist(), (view + 1).tolist(), position.tolist())
    for point, image_id, index in zip(*ends, strict=True):
        tracks[point].add_element(image_id, index)
    black = torch.zeros(len(tracks), 3, dtype=torch.uint8)
    rgb = (black if colors is None else colors.cpu()).numpy()
    for xyz, track, color in zip(model.points_world.numpy(), tracks, rgb, strict=True):
        reconstruction.add_point3D(xyz, track, color)
    reconstruction.update_point_3d_errors()
    return reconstruction


def observation_errors(model: SparseModel) -> Float[Tensor, " observation"]:
    """Return the reprojection error of each observation, in pixels.

    Infinite for a point behind the camera.
    """
    residual = torch.full_like(model.observation_pixels[:, 0], torch.inf)
    for index, lens in enumerate(model.lenses):
        in_view = torch.nonzero(model.observation_view == index)[:, 0]
        points = model.points_world[model.observation_point[in_view]]
        expected = distort(lens, transform(model.cam_from_world[index], points))
        distance = (expected - model.observation_pixels[in_view]).norm(dim=-1)
        residual[in_view] = distance.nan_to_num(nan=torch.inf)
    return residual


def reprojection_errors(model: SparseModel) -> Float[Tensor, " point"]:
    """Return the mean of :func:`observation_errors` over each point's track."""
    total = torch.zeros_like(model.points_world[:, 0])
    total = total.index_add(0, model.observation_point, observation_errors(model))
    count = torch.bincount(model.observation_point, minlength=len(total))
    return total / count.clamp_min(1)


def bundle(
    model: SparseModel, scale_px: float, *, cameras: bool = True, tolerance: float = 1e-6
) -> SparseModel:
    """Adjust poses, lenses and points robustly to the observations.

    Principal points are fixed; focal lengths and distortions are adjusted, one set per lens. Runs
    on one thread, so that results are reproducible bit for bit.

    Args:
        scale_px: Residual at which Cauchy's weight is a half.

    Returns:
        Views, points and observations in the same order.
    """
    pycolmap = loaded()

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_principal_point = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = scale_px
    options.ceres.solver_options.max_num_iterations = 100
    options.ceres.solver_options.function_tolerance = tolerance
    options.ceres.solver_options.num_threads = 1
    with quiet():
        reconstruction = reconstruction_of(model)
        config = pycolmap.BundleAdjustmentConfig()
        for image_id in reconstruction.reg_image_ids():
            config.add_image(image_id)
            if not cameras:
                image = reconstruction.image(image_id)
                config.set_constant_rig_from_world_pose(image.frame_id)
                config.set_constant_cam_intrinsics(image.camera_id)
        if cameras:
            config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        pycolmap.create_default_bundle_adjuster(options, config, reconstruction).solve()
    points = [reconstruction.point3D(point + 1).xyz for point in range(len(model.points_world))]
    images = [reconstruction.image(view + 1) for view in range(model.num_views)]
    poses = torch.from_numpy(np.array([image.cam_from_world().matrix() for image in images]))
    return model.replace(
        lenses=tuple(lens_of(reconstruction.camera(lens.camera)) for lens in model.lenses),
        cam_from_world=torch.cat([poses, model.cam_from_world[:, 3:]], dim=1),
        points_world=torch.from_numpy(np.array(points).reshape(-1, 3)),
    )
