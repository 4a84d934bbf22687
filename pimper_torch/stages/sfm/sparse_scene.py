"""Conversion of a sparse model and photographs to the scene, and back to COLMAP's files."""

from pathlib import Path

import torch
from jaxtyping import UInt8
from torch import Tensor
from torch.nn.functional import grid_sample

from pimper_torch.geometry.lens_models import photographed, pinhole_lenses
from pimper_torch.geometry.local_frame import from_local, local_origin, to_local
from pimper_torch.geometry.pixels import grid_from_pixels
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.undistortion import undistort
from pimper_torch.io.cameras.existing import registered_views
from pimper_torch.priors.undistort import with_undistorted_priors
from pimper_torch.radiometry import SATURATED, to_bytes
from pimper_torch.records import Cameras, Failure, SparseScene, Views
from pimper_torch.records.scene import with_points, with_views
from pimper_torch.records.sparse_model import SparseModel
from pimper_torch.runtime.errors import ReconstructionError
from pimper_torch.runtime.failures import skipped
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.mapped import each
from pimper_torch.stages.sfm.colmap import reprojection_errors, write_binary
from pimper_torch.stages.sfm.photograph_check import of_something_else


def assemble_scene(views: Views, model: SparseModel) -> SparseScene:
    """Return the scene of undistorted registered photographs, priors, cameras and cloud.

    Returns:
        Views in the model's order. Device and dtype are those of the photographs. A model far from
        its origin, such as a georeferenced one, is shifted, see ``SparseScene.offset_world``.
    """
    offset = local_origin(model.cam_from_world, model.points_world)
    model = model.replace(
        cam_from_world=to_local(model.cam_from_world, offset),
        points_world=model.points_world - model.points_world.new_tensor(offset),
    )
    undistorted, intrinsics = undistort(registered_views(views, model), model.lenses)
    like = views.images
    scene = SparseScene(
        views=undistorted.replace(folder=""),  # the scene is the same from another folder
        cameras=Cameras(
            intrinsics=intrinsics,
            cam_from_world=model.cam_from_world.to(like),
            sizes_px=undistorted.sizes_px,
        ),
        points_world=model.points_world.to(like),
        reprojection_errors_px=reprojection_errors(model).to(like),
        observation_point=model.observation_point.to(like.device),
        observation_view=model.observation_view.to(like.device),
        observation_pixels=model.observation_pixels.to(like),
        lenses=model.lenses,
        unregistered=tuple(name for name in views.names if name not in model.names),
        background_from_view=model.background_from_view.to(like),
        offset_world=offset,
        sessions=model.sessions.to(like.device),
    )
    return with_undistorted_priors(scene)


def model_of_scene(scene: SparseScene) -> SparseModel:
    """Return the model of a scene: pinholes of its undistorted photographs, points and tracks.

    It is in the frame of the model that the scene was made from.
    """
    poses = scene.cameras.cam_from_world.detach().cpu().double()
    offset = torch.tensor(scene.offset_world, dtype=torch.float64)
    return SparseModel(
        names=scene.views.names,
        lenses=pinhole_lenses(scene.cameras),
        cam_from_world=from_local(poses, scene.offset_world),
        points_world=scene.points_world.detach().cpu().double() + offset,
        observation_point=scene.observation_point.cpu(),
        observation_view=scene.observation_view.cpu(),
        observation_pixels=scene.observation_pixels.detach().cpu().double(),
    )


def with_model_points(scene: SparseScene, model: SparseModel) -> SparseScene:
    """Replace points and tracks by those of a :func:`model_of_scene`; cameras stay."""
    like, offset = scene.points_world, torch.tensor(scene.offset_world, dtype=torch.float64)
    pixels = photographed(scene, model.observation_pixels, model.observation_view)
    return scene.replace(
        points_world=(model.points_world - offset).to(like),
        reprojection_errors_px=reprojection_errors(model).to(like),
        observation_point=model.observation_point.to(like.device),
        observation_view=model.observation_view.to(like.device),
        observation_pixels=pixels.to(like),
    )


def write_model(
    scene: SparseScene, folder: Path, colors: UInt8[Tensor, "point 3"] | None = None
) -> None:
    """Write the scene as a COLMAP model in the frame of its original model.

    Cameras have the photographs' own lenses, not pinholes, and observations are in distorted
    pixels: the model belongs to the loaded photographs; reading it with them gives the same scene.

    Args:
        colors: Those of :func:`point_colors`, if they are known.
    """
    model = model_of_scene(scene).replace(lenses=scene.lenses)
    write_binary(model, point_colors(scene) if colors is None else colors, folder)


def point_colors(scene: SparseScene) -> UInt8[Tensor, "point 3"]:
    """Return the mean colour of the views that observe a point, as 8-bit sRGB."""
    images = scene.views.images
    height, width = images.shape[-2:]
    total = images.new_zeros(len(scene.points_world), images.shape[1])
    for index in range(scene.views.num_views):
        in_view = scene.observation_point[scene.observation_view == index]
        pose, K = scene.cameras.cam_from_world[index], scene.cameras.intrinsics[index]
        pixels, _ = project(scene.points_world[in_view], pose, K)
        grid = grid_from_pixels(pixels, width, height)[None, None]
        colors = grid_sample(images[index][None], grid, mode="bilinear", align_corners=False)
        total = total.index_add(0, in_view, colors[0, :, 0].T)
    count = torch.bincount(scene.observation_point, minlength=len(total)).clamp_min(1)
    return to_bytes((total / count[:, None]).expand(-1, 3))


@torch.no_grad()
def sound(scene: SparseScene) -> SparseScene:
    """Remove views without usable pixels or the camera's view, and points that are not finite.

    Args:
        scene: Photographs, cameras and cloud. If all can be used, it is returned itself.
    """
    finite = scene.points_world.isfinite().all(dim=1)
    leave_out("sfm.sound_points", ~finite)
    if not bool(finite.all()):
        share = f"{int((~finite).sum())} of {len(finite)}"
        skipped(_failure("points", share, "their coordinates are not finite", "They are skipped"))
        scene = with_points(scene, finite)
    reasons: dict[int, str] = {}
    others = of_something_else(scene)
    masks = scene.views.masks
    for view, (image, valid) in enumerate(each(scene.views.images, scene.views.inside)):
        lit = ((image > 0) & (image < SATURATED)).any(dim=0) & valid  # false for NaN
        reason = _nowhere(scene, view)
        if not reason and not bool(lit.any()):
            reason = "it is black, saturated or not finite everywhere"
        elif not reason and masks is not None and not bool((lit & masks[view]).any()):
            reason = "its mask is empty, or contains no lit pixel"
        if reason := reason or others.get(view, ""):
            reasons[view] = reason
    unusable = [scene.views.names[view] for view in reasons]
    leave_out("sfm.sound_views", len(unusable), total=scene.views.num_views, names=unusable)
    if not reasons:
        return scene
    names, usable = scene.views.names, scene.views.num_views - len(reasons)
    if usable < 3:  # a sweep compares at least three
        listed = "; ".join(f"{names[view]}: {reason}" for view, reason in reasons.items())
        raise ReconstructionError(
            f"{usable} of {scene.views.num_views} views can be used; needed: 3. {listed}. Check "
            "these photographs, masks and cameras."
        )
    done = "These views are skipped, as if they did not exist"
    skipped(*(_failure("view", names[view], reason, done) for view, reason in reasons.items()))
    return with_views(scene, torch.tensor([view not in reasons for view in range(len(names))]))


def _failure(what: str, name: str, reason: str, done: str) -> Failure:
    return Failure(stage="cameras", what=what, name=name, reason=reason, done=done)


def _nowhere(scene: SparseScene, view: int) -> str:
    """Return why a camera is invalid, or an empty string."""
    pose, intrinsics = scene.cameras.cam_from_world[view], scene.cameras.intrinsics[view]
    if not bool(pose.isfinite().all() and intrinsics.isfinite().all()):
        return "its camera has numbers that are not finite"
    points = scene.points_world[scene.observation_point[scene.observation_view == view]]
    if len(points) == 0:
        return ""
    pixels, depth = project(points, pose, intrinsics)
    size = scene.cameras.sizes_px[view]
    within = (pixels > -0.1 * size) & (pixels < 1.1 * size)
    share = float((within.all(dim=1) & (depth > 0)).float().mean())
    if share >= 0.5:  # far below that of any valid camera
        return ""
    return f"only {share:.0%} of the points that its camera observes are in its frame"
