"""Which views of a scene can be used at all, and the scene without the others."""

from collections.abc import Iterator

import torch
from jaxtyping import Bool
from torch import Tensor

from pimper_torch.errors import ReconstructionError
from pimper_torch.failures import skipped
from pimper_torch.geometry.projection import project
from pimper_torch.ledger import leave_out
from pimper_torch.mapped import each
from pimper_torch.radiometry import SATURATED
from pimper_torch.records import Failure, SparseScene


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
    reasons = dict(_unusable(scene))
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


def with_views(scene: SparseScene, kept: Bool[Tensor, " view"]) -> SparseScene:
    """Keep some of the views, and what these observe; the others count as not registered."""
    index = kept.nonzero()[:, 0].tolist()
    observed = kept.to(scene.observation_view.device)[scene.observation_view]
    number = kept.long().cumsum(dim=0).to(scene.observation_view.device) - 1
    maps, series, names = scene.background_from_view, scene.series, scene.views.names
    left_out = tuple(name for name, keep in zip(names, kept.tolist(), strict=True) if not keep)
    return scene.replace(
        views=scene.views.take(index),
        cameras=scene.cameras.take(index),
        observation_point=scene.observation_point[observed],
        observation_view=number[scene.observation_view[observed]],
        observation_pixels=scene.observation_pixels[observed],
        lenses=tuple(scene.lenses[view] for view in index) if scene.lenses else (),
        unregistered=(*scene.unregistered, *left_out),
        background_from_view=maps[kept.to(maps.device)] if len(maps) else maps,
        series=series[kept.to(series.device)] if len(series) else series,
    )


def with_points(scene: SparseScene, kept: Bool[Tensor, " point"]) -> SparseScene:
    """Keep some of the points, and where they were observed."""
    observed = kept[scene.observation_point]
    number = kept.long().cumsum(dim=0) - 1
    return scene.replace(
        points_world=scene.points_world[kept],
        reprojection_errors_px=scene.reprojection_errors_px[kept],
        observation_point=number[scene.observation_point[observed]],
        observation_view=scene.observation_view[observed],
        observation_pixels=scene.observation_pixels[observed],
    )


def _failure(what: str, name: str, reason: str, done: str) -> Failure:
    return Failure(stage="cameras", what=what, name=name, reason=reason, done=done)


def _unusable(scene: SparseScene) -> Iterator[tuple[int, str]]:
    """List the views that cannot be used, each with the reason."""
    masks = scene.views.masks
    for view, (image, shown) in enumerate(each(scene.views.images, scene.views.inside)):
        lit = ((image > 0) & (image < SATURATED)).any(dim=0) & shown  # false for NaN
        reason = _nowhere(scene, view)
        if not reason and not bool(lit.any()):
            reason = "it is black, saturated or not finite all over"
        elif not reason and masks is not None and not bool((lit & masks[view]).any()):
            reason = "its mask is empty, or shows nothing that is lit"
        if reason:
            yield view, reason


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
