"""Silhouettes that all others contradict, as a mask that is inverted or of another object.

A pixel of a silhouette agrees with the other views where some place on its ray is inside all of
theirs: the silhouettes are coherent (Hernández, Schmitt and Cipolla, PAMI 29(2), 2007). Else the
place counts that fewest of them deny, and these are in conflict with it. The view with most
conflicts is left out, until the rest agree.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool2d

from pimper_torch.geometry.pixels import grid_from_pixels, scale_intrinsics
from pimper_torch.geometry.projection import project, rays_through
from pimper_torch.mapped import by_view, zeros
from pimper_torch.parallel import side_by_side
from pimper_torch.records import Cameras, Silhouettes
from pimper_torch.silhouettes.contours import box_round
from pimper_torch.silhouettes.opencv import signed_distance

# Pixels of each silhouette that are looked at and places on their rays; longer side of the pictures
# in which that is done: choices.
_PIXELS, _PLACES, _SIZE_PX = 100, 64, 320
# Of the longer side, up to which a place may lie outside of a silhouette: masks are drawn by hand.
_SLACK = 0.01
# Fraction of the others that must see a place.
_SEEN = 0.5
# Fraction of a silhouette's pixels in conflict, or of the median other's in conflict with it: 0.00
# of true masks (potatoes and mug along an arc, jar and spot on a turntable, balls by hand, 8 to 12
# views of 240x180 and 320x240). Where those of one or two views are wrong, theirs is 0.30 and more
# if they are all of the picture, 0.56 if inverted, 0.86 if a pixel; masks drawn 5 px too wide and 4
# px too narrow in turns are up to 0.22.
_MOST = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class _Conflicts:
    """Which views deny places on the rays of the pixels of each view.

    Attributes:
        denied: By each view, places on the rays of each view's pixels; never by that view itself.
        seen: By each view.
    """

    denied: Bool[Tensor, "view other pixel place"]
    seen: Bool[Tensor, "view other pixel place"]

    def of(
        self, chosen: Bool[Tensor, " view"]
    ) -> tuple[Float[Tensor, " view"], Float[Tensor, "view other"]]:
        """Compute the fraction of each view's pixels in conflict, and in conflict with each view.

        Args:
            chosen: Views that take part; all others have no conflicts.
        """
        most = chosen.sum() - 1

        def of_view(denied: Tensor, seen: Tensor) -> Tensor:
            denied, seen = (one & chosen[:, None, None] for one in (denied, seen))
            count = torch.where(seen.sum(dim=0) >= _SEEN * most, denied.sum(dim=0), len(chosen))
            fewest = count.amin(dim=-1)
            valid = fewest < len(chosen)
            best = (count == fewest[:, None]) & valid[:, None]
            share = (denied & best).sum(dim=-1) / best.sum(dim=-1).clamp_min(1)
            total = valid.sum().clamp_min(1)
            own = (valid & (fewest > 0)).sum() / total
            return torch.cat([own[None], share.sum(dim=-1) / total])

        found = by_view(of_view, self.denied, self.seen) * chosen[:, None]
        return found[:, 0], found[:, 1:]


def contradictory(silhouettes: Silhouettes, cameras: Cameras) -> Bool[Tensor, " view"]:
    """Find the reliable views whose silhouettes clearly contradict those of the others.

    Args:
        silhouettes: At least one pixel in every reliable view.

    Returns:
        All of them where fewer than three, or no more than half, would agree.
    """
    views = silhouettes.reliable.nonzero()[:, 0].cpu()
    box = box_round(silhouettes, cameras)
    if box is None:
        return torch.zeros_like(silhouettes.reliable)
    masks = silhouettes.take(views.tolist()).masks
    conflicts = _conflicts(masks, cameras.take(views.tolist()), box)
    left = torch.ones(len(views), dtype=torch.bool)
    while left.sum() >= max(3, len(views) // 2 + 1):
        own, with_others = conflicts.of(left)
        mine = torch.eye(len(left), dtype=torch.bool) | ~left[:, None]
        between = with_others.masked_fill(mine, torch.nan).nanmedian(dim=0).values
        clear = (torch.maximum(own, between) > _MOST) & left
        if not bool(clear.any()):
            doubted = torch.zeros_like(silhouettes.reliable)
            doubted[views[~left]] = True
            return doubted
        involved = (own + with_others.sum(dim=0)).masked_fill(~clear, -1)
        left[involved.argmax()] = False
    return silhouettes.reliable.clone()


def _conflicts(
    masks: Bool[Tensor, "view height width"], cameras: Cameras, box_world: Float[Tensor, "2 3"]
) -> _Conflicts:
    """Follow rays through pixels of each silhouette in smaller pictures."""
    by = max(1, math.ceil(max(masks.shape[1:]) / _SIZE_PX))
    small = by_view(
        lambda mask: max_pool2d(mask[None].float().cpu(), by, ceil_mode=True)[0] > 0, masks
    )
    cameras = cameras.to("cpu").to(torch.float32)
    cameras = cameras.replace(
        intrinsics=scale_intrinsics(cameras.intrinsics, 1 / by, 1 / by),
        sizes_px=-(-cameras.sizes_px // by),
    )
    borders = torch.stack(list(side_by_side(signed_distance, list(small), tracked=False)))

    def followed(view: int) -> tuple[Tensor, Tensor]:
        places, step = _places(small[view], cameras.take([view]), box_world.cpu().float())
        pixels, depth = project(places, cameras.cam_from_world, cameras.intrinsics)
        pixels = pixels.reshape(len(small), -1, _PLACES, 2)
        depth = depth.reshape(len(small), -1, _PLACES)
        size = cameras.sizes_px[:, None, None]
        seen = ((pixels > 0) & (pixels < size)).all(dim=-1) & (depth > 0)
        seen[view] = False
        height, width = borders.shape[1:]
        value = grid_sample(
            borders[:, None], grid_from_pixels(pixels, width, height), align_corners=False
        )[:, 0]
        reach = step[:, None] * cameras.intrinsics[:, 0, 0, None, None] / depth
        return seen & (value < -reach - _SLACK * max(height, width)), seen

    shape = len(small), len(small), _PIXELS, _PLACES
    conflicts = _Conflicts(denied=zeros(shape, torch.bool), seen=zeros(shape, torch.bool))
    for view, found in enumerate(side_by_side(followed, range(len(small)), tracked=False)):
        conflicts.denied[view], conflicts.seen[view] = found
    return conflicts


def _places(
    mask: Bool[Tensor, "height width"], camera: Cameras, box_world: Float[Tensor, "2 3"]
) -> tuple[Float[Tensor, "place 3"], Float[Tensor, " pixel"]]:
    """List places in the box on rays through pixels of a mask, and half of the way between them."""
    shown = mask.nonzero()
    shown = shown[torch.linspace(0, len(shown) - 1, _PIXELS).round().long()]
    rays = rays_through(shown.flip(1).float() + 0.5, camera.cam_from_world[0], camera.intrinsics[0])
    eye = camera.centers_world[0]
    ends = (box_world[:, None] - eye) / torch.where(rays.abs() > 1e-9, rays, 1e-9)
    near = ends.amin(dim=0).amax(dim=-1).clamp_min(0)
    far = torch.maximum(ends.amax(dim=0).amin(dim=-1), near)
    along = near[:, None] + (far - near)[:, None] * torch.linspace(0, 1, _PLACES)
    half = (far - near) * rays.norm(dim=-1) / (2 * (_PLACES - 1))
    return (eye + along[..., None] * rays[:, None]).flatten(0, 1), half
