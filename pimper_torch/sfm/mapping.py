"""Models grown from verified matches."""

import tempfile
from itertools import count
from typing import Any

import torch
from torch import Tensor

from pimper_torch.progress import report
from pimper_torch.sfm.colmap import loaded, model_of, quiet, reconstruction_of
from pimper_torch.sfm.features import Workspace
from pimper_torch.sfm.matching import MOST_PAIRED
from pimper_torch.sfm.model import SparseModel
from pimper_torch.sfm.reconstruct_config import MIN_POINTS

# Growth of a model between two adjustments of all of it. COLMAP's own 1.1 suits models that are
# final, and takes 29 in place of 25 CPU s on 66 photographs; here tracks are found again, and
# everything is adjusted to them.
_GROWTH = 1.2


def map_views(space: Workspace, seed: int, *, pairs_count: bool = False) -> list[SparseModel]:
    """Grow models from the best pair of views on, until no view can be added.

    On one thread, so that the same matches give the same bits.

    Args:
        pairs_count: Points that only two views see take part, too: they tie views with
            little overlap, less exactly.

    Returns:
        One model a component, the one with most views first. Names are files of ``space``.
    """
    pycolmap = loaded()

    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 3
    options.extract_colors = False
    options.num_threads = 1
    options.random_seed = seed
    options.mapper.abs_pose_min_num_inliers = MIN_POINTS
    options.ba_global_frames_ratio = options.ba_global_points_ratio = _GROWTH
    options.triangulation.ignore_two_view_tracks = not pairs_count
    if len(space.files) > MOST_PAIRED:
        # Half of the CPU seconds, with the same cameras after tracks are found again.
        options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.4
        options.ba_global_max_refinements, options.ba_local_max_refinements = 2, 1
        options.ba_global_function_tolerance = 1e-4
        options.ba_local_function_tolerance = 1e-4
    registered, total = count(3), len(space.files)  # the first call follows a model of two views

    def tell() -> None:
        report(min(next(registered), total), total)  # models that begin anew add views again

    with tempfile.TemporaryDirectory(dir=space.folder) as output, quiet():
        found = pycolmap.incremental_mapping(
            space.database, space.images, output, options, next_image_callback=tell
        )
    models = [model_of(reconstruction) for reconstruction in found.values()]
    return sorted(models, key=lambda model: (-model.num_views, -len(model.points_world)))


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
        scale_px: Residual at which Cauchy's weight is a half.

    Returns:
        Views, points and observations in their old order.
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
        reconstruction = reconstruction_of(model, _no_colors(model))
        config = _everything(reconstruction) if cameras else _points_alone(reconstruction)
        pycolmap.create_default_bundle_adjuster(options, config, reconstruction).solve()
    return model_of(reconstruction).replace(
        background_from_view=model.background_from_view, series=model.series
    )


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
