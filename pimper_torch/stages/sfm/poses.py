"""Several photographs per pose, each under a different light: one of them is used for geometry.

Photographs of one pose have no parallax between them. Structure from motion gets one image per
pose, and its result applies to all photographs of the pose; silhouettes and depth maps are those of
one photograph per pose. Lights are fitted to all.
"""

from collections.abc import Collection, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.records import Cameras, Prior, SilhouettePrior, SparseScene, Views, pairs_table
from pimper_torch.records.scene import ViewPerPose, with_views
from pimper_torch.records.shapes import Scalar
from pimper_torch.records.sparse_model import SparseModel, select_views
from pimper_torch.runtime.errors import InputError, some
from pimper_torch.runtime.mapped import by_view


def mean_images(views: Views) -> Views:
    """Return the mean radiance of the photographs of each pose; without poses, the views.

    Returns:
        Images in the order of the poses, named after their first photographs. The object is the
        union of the masks of a pose.
    """
    if views.poses is None:
        return views
    groups = [(views.poses == pose).nonzero()[:, 0] for pose in sorted(set(views.poses.tolist()))]
    uneven = [
        views.names[int(group[0])]
        for group in groups
        if bool((views.sizes_px[group] != views.sizes_px[group[:1]]).any())
    ]
    if uneven:
        raise InputError(
            f"Photographs of the poses of {some(uneven)} have different sizes; needed: one size "
            "per pose, as from a static camera. Put each of the others in a separate folder."
        )
    first = views.take([int(group[0]) for group in groups])
    masks = views.masks
    return first.replace(
        images=by_view(lambda group: views.images[group].mean(dim=0), groups),
        masks=None if masks is None else by_view(lambda group: masks[group].any(dim=0), groups),
        focals_px=torch.stack([views.focals_px[group].nanmedian() for group in groups]),
        poses=None,
    )


def expand_to_photographs(model: SparseModel, views: Views) -> SparseModel:
    """Copy the model of :func:`mean_images` to all photographs of the poses."""
    if views.poses is None:
        return model
    index_of = {name: index for index, name in enumerate(model.names)}
    first = {pose: view for view, pose in reversed(list(enumerate(views.poses.tolist())))}
    source = [index_of.get(views.names[first[pose]], -1) for pose in views.poses.tolist()]
    registered = [view for view, i in enumerate(source) if i >= 0]
    copied = select_views(model, [source[view] for view in registered])
    return copied.replace(names=tuple(views.names[view] for view in registered))


def with_poses(scene: SparseScene) -> SparseScene:
    """Number the poses of a scene if given cameras are equal."""
    if scene.views.poses is not None or scene.cameras.num_views < 2:
        return scene
    poses = equal_poses(scene.cameras)
    if len(set(poses.tolist())) == len(poses):
        return scene
    return scene.replace(views=scene.views.replace(poses=poses.to(scene.views.sizes_px)))


def equal_poses(cameras: Cameras) -> Int[Tensor, " view"]:
    """Return the pose number of each camera; those within half a pixel at the object are equal."""
    pose = cameras.cam_from_world.detach().double()
    centers = cameras.centers_world.detach().double()
    focal = cameras.intrinsics[:, 0, 0].detach().double()
    # Cameras around an object are about as far from each other as from it.
    extent = (centers - centers.mean(dim=0)).norm(dim=1).mean()
    turned = (pose[:, None, :3, :3] - pose[None, :, :3, :3]).flatten(2).norm(dim=2) / 2**0.5
    moved = (centers[:, None] - centers).norm(dim=2)
    # Bundle adjustment leaves photographs of one pose 0.1 px apart, and neighbours by tens.
    same = focal[:, None] * (turned + moved / extent) < 0.5
    return same.long().argmax(dim=1)  # the first of each pose


def one_view_per_pose(scene: SparseScene, needed: Collection[str] = ()) -> ViewPerPose:
    """Return the scene with the most textured photograph of every pose; without poses, the scene.

    Given silhouettes of other photographs of a pose become those of the kept one.

    Args:
        needed: Names, with or without suffix, of preferred photographs.
    """
    poses = scene.views.poses
    if poses is None:
        all_views = torch.arange(scene.cameras.num_views)
        return ViewPerPose(scene, all_views, all_views)
    rank = by_view(_texture, scene.views.images, scene.views.sizes_px)
    for view, name in enumerate(scene.views.names):
        if {name, name.rsplit(".", 1)[0]} & set(needed):
            rank[view] += 1
    numbers = poses.tolist()
    best = {pose: int(torch.where(poses == pose, rank, -1).argmax()) for pose in set(numbers)}
    lead = torch.tensor([best[pose] for pose in numbers], device=poses.device)
    point, observer = scene.observation_point, lead[scene.observation_view]
    table = pairs_table(point, observer, (len(scene.points_world), len(numbers)))
    pixels = scene.observation_pixels.new_zeros(*table.shape, 2)
    pixels[point, observer] = scene.observation_pixels
    point, observer = table.nonzero(as_tuple=True)
    kept = torch.bincount(lead, minlength=len(lead)) > 0
    pixels = pixels[point, observer]
    merged = scene.replace(
        observation_point=point, observation_view=observer, observation_pixels=pixels
    )
    kept_scene = with_views(merged, kept)
    priors = tuple(_with_leads(x, scene.views.names, lead) for x in kept_scene.views.priors)
    views = kept_scene.views.replace(poses=None, priors=priors)
    kept_scene = kept_scene.replace(views=views, unregistered=scene.unregistered)
    return ViewPerPose(kept_scene, kept.nonzero()[:, 0], (kept.long().cumsum(dim=0) - 1)[lead])


def _with_leads(prior: Prior, names: Sequence[str], lead: Int[Tensor, " view"]) -> Prior:
    """Move silhouettes of a pose's photographs to its ``lead``, unless that has one of its own."""
    if not isinstance(prior, SilhouettePrior):
        return prior
    leads = dict(zip(names, (names[i] for i in lead.tolist()), strict=True))
    maps = {
        leads[name]: index
        for index, name in reversed(list(enumerate(prior.names)))
        if name in leads
    }
    maps |= {name: index for index, name in enumerate(prior.names) if leads.get(name) == name}
    return prior.take(list(maps.values())).replace(names=tuple(maps))


def _texture(image: Float[Tensor, "channel _ _"], size: Int[Tensor, "2"]) -> Scalar:
    """Return the mean step of the square root of radiance between horizontal neighbours."""
    wide, high = size.tolist()
    root = image.detach().mean(dim=0).clamp(0, 1).sqrt()
    return root[:high, 1:wide].sub(root[:high, : wide - 1]).abs().mean()
