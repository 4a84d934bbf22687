"""From a sparse model and the photographs to the scene, and back to COLMAP's files."""

from pathlib import Path

import torch
from jaxtyping import UInt8
from torch import Tensor
from torch.nn.functional import grid_sample

from pimper_torch.ground.geometry.lens_models import photographed, pinhole_lenses
from pimper_torch.ground.geometry.local_frame import NO_OFFSET, from_local, local_origin, to_local
from pimper_torch.ground.geometry.pixels import grid_from_pixels
from pimper_torch.ground.geometry.projection import project
from pimper_torch.ground.radiometry import SATURATED, to_bytes
from pimper_torch.method.sfm.colmap import reprojection_errors, write_binary
from pimper_torch.method.sfm.existing import registered_views
from pimper_torch.method.sfm.model import SparseModel
from pimper_torch.method.sfm.undistort import undistort, with_undistorted_priors
from pimper_torch.records import Cameras, Failure, SparseScene, Views
from pimper_torch.records.scene import with_points, with_views
from pimper_torch.runtime.errors import ReconstructionError
from pimper_torch.runtime.failures import skipped
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.mapped import each


def assemble_scene(views: Views, model: SparseModel) -> SparseScene:
    """Undistort the registered photographs and priors, and put them beside cameras and cloud.

    Returns:
        Views in the model's order. Device and dtype are those of the photographs. A model far from
        its origin, such as a georeferenced one, is shifted, see ``SparseScene.offset_world``.
    """
    offset = local_origin(model.cam_from_world, model.points_world)
    if offset != NO_OFFSET:
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
    """Return the cameras of a scene, as pinholes of its undistorted photographs, and its tracks.

    They are in the frame of the model that the scene came from.
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
    """Put points and tracks of :func:`model_of_scene` into the scene, its cameras untouched."""
    like, offset = scene.points_world, torch.tensor(scene.offset_world, dtype=torch.float64)
    pixels = photographed(scene, model.observation_pixels, model.observation_view)
    return scene.replace(
        points_world=(model.points_world - offset).to(like),
        reprojection_errors_px=reprojection_errors(model).to(like),
        observation_point=model.observation_point.to(like.device),
        observation_view=model.observation_view.to(like.device),
        observation_pixels=pixels.to(like),
    )


def write_model(scene: SparseScene, folder: Path) -> None:
    """Write the scene as a COLMAP model in the frame of the model that it came from.

    The cameras are the photographs' own lenses, not the pinholes, and the observations are
    where they were made: the model belongs to the photographs as they were loaded, and
    reading it back with them gives the same scene.
    """
    model = model_of_scene(scene).replace(lenses=scene.lenses)
    write_binary(model, point_colors(scene), folder)


def point_colors(scene: SparseScene) -> UInt8[Tensor, "point 3"]:
    """Average what the views that see a point show there, as 8-bit sRGB."""
    images = scene.views.images
    height, width = images.shape[-2:]
    total = images.new_zeros(len(scene.points_world), images.shape[1])
    for index in range(scene.views.num_views):
        seen = scene.observation_point[scene.observation_view == index]
        pose, K = scene.cameras.cam_from_world[index], scene.cameras.intrinsics[index]
        pixels, _ = project(scene.points_world[seen], pose, K)
        grid = grid_from_pixels(pixels, width, height)[None, None]
        colors = grid_sample(images[index][None], grid, mode="bilinear", align_corners=False)
        total = total.index_add(0, seen, colors[0, :, 0].T)
    count = torch.bincount(scene.observation_point, minlength=len(total)).clamp_min(1)
    return to_bytes((total / count[:, None]).expand(-1, 3))


@torch.no_grad()
def sound(scene: SparseScene) -> SparseScene:
    """Leave out views that show nothing or stand nowhere, and points that are nowhere.

    Args:
        scene: Photographs, cameras and cloud. Where all can be used, it is returned as it is.
    """
    finite = scene.points_world.isfinite().all(dim=1)
    leave_out("sfm.sound_points", ~finite)
    if not bool(finite.all()):
        lost = f"{int((~finite).sum())} of {len(finite)}"
        skipped(_failure("points", lost, "their coordinates are not finite", "They are left out"))
        scene = with_points(scene, finite)
    reasons: dict[int, str] = {}
    masks = scene.views.masks
    for view, (image, shown) in enumerate(each(scene.views.images, scene.views.inside)):
        lit = ((image > 0) & (image < SATURATED)).any(dim=0) & shown  # false for NaN
        reason = _nowhere(scene, view)
        if not reason and not bool(lit.any()):
            reason = "it is black, saturated or not finite all over"
        elif not reason and masks is not None and not bool((lit & masks[view]).any()):
            reason = "its mask is empty, or shows nothing that is lit"
        if reason:
            reasons[view] = reason
    unusable = [scene.views.names[view] for view in reasons]
    leave_out("sfm.sound_views", len(unusable), total=scene.views.num_views, names=unusable)
    if not reasons:
        return scene
    names, left = scene.views.names, scene.views.num_views - len(reasons)
    if left < 3:  # the least that a sweep compares
        listed = "; ".join(f"{names[view]}: {reason}" for view, reason in reasons.items())
        raise ReconstructionError(
            f"{left} of {scene.views.num_views} views can be used; needed: 3. {listed}. Look at "
            "these photographs, masks and cameras."
        )
    done = "These views are left out, as if they had not been taken"
    skipped(*(_failure("view", names[view], reason, done) for view, reason in reasons.items()))
    return with_views(scene, torch.tensor([view not in reasons for view in range(len(names))]))


def _failure(what: str, name: str, reason: str, done: str) -> Failure:
    return Failure(stage="cameras", what=what, name=name, reason=reason, done=done)


def _nowhere(scene: SparseScene, view: int) -> str:
    """State why a camera cannot be where it is said to be, if so."""
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
    if share >= 0.5:  # far below any camera of a model, whose points reproject within pixels
        return ""
    return f"its camera has {share:.0%} of the points that it observed in its frame"
