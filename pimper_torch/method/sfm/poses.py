"""Several photographs of one pose, each under a different light: one is used for geometry.

Photographs of one pose have no parallax to one another. Structure from motion gets one picture a
pose, and what it finds holds for all photographs of the pose; silhouettes and depth maps are those
of one photograph a pose. Lights are fitted to all.
"""

from collections.abc import Collection, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.ground.shapes import Scalar
from pimper_torch.method.sfm.model import SparseModel, select_views
from pimper_torch.records import Cameras, Prior, SilhouettePrior, SparseScene, Views, pairs_table
from pimper_torch.records.scene import ViewPerPose, with_views
from pimper_torch.runtime.errors import InputError, some
from pimper_torch.runtime.mapped import by_view


def pictures_of_poses(views: Views) -> Views:
    """Average the radiance of the photographs of each pose; without poses, return the views.

    Returns:
        Pictures in the order of the poses, under the names of their first photographs. The object
        is where any of a pose's masks shows it.
    """
    if views.poses is None:
        return views
    groups = [(views.poses == pose).nonzero()[:, 0] for pose in sorted(set(views.poses.tolist()))]
    uneven = [
        views.names[int(own[0])]
        for own in groups
        if bool((views.sizes_px[own] != views.sizes_px[own[:1]]).any())
    ]
    if uneven:
        raise InputError(
            f"Photographs of the poses of {some(uneven)} have unlike sizes; needed: one size a "
            "pose, as of a camera that stands still. Put each of the others in a folder of its own."
        )
    first = views.take([int(own[0]) for own in groups])
    masks = views.masks
    return first.replace(
        images=by_view(lambda own: views.images[own].mean(dim=0), groups),
        masks=None if masks is None else by_view(lambda own: masks[own].any(dim=0), groups),
        focals_px=torch.stack([views.focals_px[own].nanmedian() for own in groups]),
        poses=None,
    )


def of_photographs(model: SparseModel, views: Views) -> SparseModel:
    """Carry what was found of :func:`pictures_of_poses` to every photograph of the poses."""
    if views.poses is None:
        return model
    place = {name: index for index, name in enumerate(model.names)}
    first = {pose: view for view, pose in reversed(list(enumerate(views.poses.tolist())))}
    source = [place.get(views.names[first[pose]], -1) for pose in views.poses.tolist()]
    shown = [view for view, found in enumerate(source) if found >= 0]
    carried = select_views(model, [source[view] for view in shown])
    return carried.replace(names=tuple(views.names[view] for view in shown))


def with_poses(scene: SparseScene) -> SparseScene:
    """Number the poses where cameras that came with the photographs are equal."""
    if scene.views.poses is not None or scene.cameras.num_views < 2:
        return scene
    poses = equal_poses(scene.cameras)
    if len(set(poses.tolist())) == len(poses):
        return scene
    return scene.replace(views=scene.views.replace(poses=poses.to(scene.views.sizes_px)))


def equal_poses(cameras: Cameras) -> Int[Tensor, " view"]:
    """Number the poses of cameras; those half a pixel apart at the object are the same."""
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
    """Keep the most textured photograph of every pose; without poses, the scene as it is.

    Guessed silhouettes of other photographs of a pose become those of the one that is kept.

    Args:
        needed: Names, with their suffix or without, of photographs that are preferred.
    """
    poses = scene.views.poses
    if poses is None:
        every = torch.arange(scene.cameras.num_views)
        return ViewPerPose(scene, every, every)
    rank = by_view(_texture, scene.views.images, scene.views.sizes_px)
    for view, name in enumerate(scene.views.names):
        if {name, name.rsplit(".", 1)[0]} & set(needed):
            rank[view] += 1
    numbers = poses.tolist()
    best = {pose: int(torch.where(poses == pose, rank, -1).argmax()) for pose in set(numbers)}
    lead = torch.tensor([best[pose] for pose in numbers], device=poses.device)
    point, seer = scene.observation_point, lead[scene.observation_view]
    table = pairs_table(point, seer, (len(scene.points_world), len(numbers)))
    pixels = scene.observation_pixels.new_zeros(*table.shape, 2)
    pixels[point, seer] = scene.observation_pixels
    point, seer = table.nonzero(as_tuple=True)
    kept = torch.bincount(lead, minlength=len(lead)) > 0
    one = scene.replace(
        observation_point=point, observation_view=seer, observation_pixels=pixels[point, seer]
    )
    few = with_views(one, kept)
    carried = tuple(_with_leads(prior, scene.views.names, lead) for prior in few.views.priors)
    views = few.views.replace(poses=None, priors=carried)
    few = few.replace(views=views, unregistered=scene.unregistered)
    return ViewPerPose(few, kept.nonzero()[:, 0], (kept.long().cumsum(dim=0) - 1)[lead])


def _with_leads(prior: Prior, names: Sequence[str], lead: Int[Tensor, " view"]) -> Prior:
    """Carry silhouettes of a pose's photographs to its ``lead``, unless that has one of its own."""
    if not isinstance(prior, SilhouettePrior):
        return prior
    leads = dict(zip(names, (names[one] for one in lead.tolist()), strict=True))
    maps = {
        leads[name]: index
        for index, name in reversed(list(enumerate(prior.names)))
        if name in leads
    }
    maps |= {name: index for index, name in enumerate(prior.names) if leads.get(name) == name}
    return prior.take(list(maps.values())).replace(names=tuple(maps))


def _texture(image: Float[Tensor, "channel _ _"], size: Int[Tensor, "2"]) -> Scalar:
    """Compute the mean step of the square root of radiance between neighbouring pixels."""
    wide, high = size.tolist()
    one = image.detach().mean(dim=0).clamp(0, 1).sqrt()
    return one[:high, 1:wide].sub(one[:high, : wide - 1]).abs().mean()
