"""COLMAP's bundle adjustment of a whole model."""

from typing import Any

import torch
from torch import Tensor

from pimper_torch.sfm.binding import loaded, quiet
from pimper_torch.sfm.colmap import model_of, reconstruction_of
from pimper_torch.sfm.model import SparseModel

_ITERATIONS = 100


def bundle(
    model: SparseModel,
    scale_px: float,
    *,
    cameras: bool = True,
    tolerance: float = 1e-6,
) -> SparseModel:
    """Adjust poses, lenses and points to the observations, robustly.

    Principal points stay; focal lengths and distortions are adjusted, one set a lens. On one
    thread, so that the same observations give the same bits.

    Args:
        model: Every point with two observations at least.
        scale_px: Residual at which Cauchy's weight is a half.
        cameras: Whether poses and lenses are adjusted, or points alone.
        tolerance: Relative fall of the cost that ends the iterations.

    Returns:
        Views, points and observations in their old order.
    """
    pycolmap = loaded()

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_principal_point = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = scale_px
    options.ceres.solver_options.max_num_iterations = _ITERATIONS
    options.ceres.solver_options.function_tolerance = tolerance
    options.ceres.solver_options.num_threads = 1
    with quiet():
        reconstruction = reconstruction_of(model, _no_colors(model))
        config = _everything(reconstruction) if cameras else _points_alone(reconstruction)
        pycolmap.create_default_bundle_adjuster(options, config, reconstruction).solve()
    return model_of(reconstruction)


def _everything(reconstruction: Any) -> Any:  # noqa: ANN401 - pycolmap has no types
    config = loaded().BundleAdjustmentConfig()
    for image_id in reconstruction.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(loaded().BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    return config


def _points_alone(reconstruction: Any) -> Any:  # noqa: ANN401 - pycolmap has no types
    config = loaded().BundleAdjustmentConfig()
    for image_id in reconstruction.reg_image_ids():
        image = reconstruction.image(image_id)
        config.add_image(image_id)
        config.set_constant_rig_from_world_pose(image.frame_id)
        config.set_constant_cam_intrinsics(image.camera_id)
    return config


def _no_colors(model: SparseModel) -> Tensor:
    return torch.zeros(len(model.points_world), 3, dtype=torch.uint8)
