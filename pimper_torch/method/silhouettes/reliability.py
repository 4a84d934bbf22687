"""Reliability of silhouettes: every view's cut against the visual hull and the background."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate, max_pool2d

from pimper_torch.ground.geometry.opencv import signed_distance
from pimper_torch.ground.geometry.pixels import grid_from_pixels, scale_intrinsics
from pimper_torch.ground.geometry.projection import project, rays_through
from pimper_torch.ground.geometry.visual_hull import box_round
from pimper_torch.ground.shapes import Map, Maps, Mask, Masks, ViewMask
from pimper_torch.method.silhouettes.cuts import DOUBT_OFF_PLANE, Cuts, doubt_of, is_deep
from pimper_torch.records import Cameras, Silhouettes, Views
from pimper_torch.runtime.mapped import by_view, zeros
from pimper_torch.runtime.parallel import side_by_side

# Fraction of a reliable silhouette that the hull's projection covers. Chosen, as the next two, on
# the four rendered scenes and the skull (benchmarks/silhouettes.py).
_MIN_COVERED = 0.9

# Fraction of it that may show a background for certain: the supporting plane, or a room at rest.
# True masks show up to 0.001, masks 20 px of 640 too wide 0.007 to 0.19 (mug, potatoes and
# scorpion, two of them on turntables).
MAX_EXPOSED = 0.01

# Fraction of the object's points that it holds. True masks hold 0.948 and more, masks 20 px too
# narrow 0.50 to 0.80 (mug, potatoes).
MIN_HELD = 0.9


def agreement_of(cuts: Cuts) -> tuple[Float[Tensor, " view"], ViewMask]:
    """Compare each view's cut with the hull's projection.

    A cut inside the projection contradicts nothing: the others may not see what it takes away, as
    at the end of an arc. A cut outside contradicts them, as where its camera is misplaced. Cuts
    that err alike agree with their hull, but not with background and points.

    Returns:
        Intersection over union of cut and projection; and the views whose cut shows something,
        nearly all of the object and nothing else.
    """

    def areas(mask: Tensor, margin: Tensor) -> Tensor:
        projection = margin > 0
        return torch.stack([one.sum() for one in (mask, mask & projection, mask | projection)])

    own, both, either = by_view(areas, cuts.masks, cuts.margins_px).double().unbind(dim=1)
    reliable = (both / own.clamp_min(1) >= _MIN_COVERED) & (own > 0)
    reliable &= (cuts.exposed <= MAX_EXPOSED) & (cuts.held >= MIN_HELD)
    return both / either.clamp_min(1), reliable


# Probability where the hull denies by more than two pixels what a cut shows.
_UNSURE_INSIDE = 0.6


def silhouettes_of(cuts: Cuts, views: Views) -> Silhouettes:
    """Give silhouettes at the photographs' size."""
    found = _at_full_size(cuts, views)
    _, reliable = agreement_of(cuts)
    hidden = None
    if cuts.hidden is not None:
        size = views.images.shape[-2:]
        hidden = by_view(
            lambda one: interpolate(one[None, None].float(), size)[0, 0] > 0, cuts.hidden
        )
    return Silhouettes(
        inside=found, reliable=reliable.to(found.device), source="found", hidden=hidden
    )


def _at_full_size(cuts: Cuts, views: Views) -> Maps:
    """Turn cuts into probabilities at the photographs' size; 0 in the padding."""
    height, width = views.images.shape[-2:]
    device = views.images.device

    def enlarged(view: int) -> Map:
        cut, margin = cuts.masks[view], cuts.margins_px[view]
        doubt = torch.where(margin > 2, DOUBT_OFF_PLANE, 0.0)
        if cuts.agreement is not None:
            own = doubt_of(cuts.agreement[view]).masked_fill(is_deep(-margin), 0)
            doubt = torch.maximum(doubt, own)
        layers = torch.stack([signed_distance(cut), margin.clamp(-100, 100), doubt])
        border, hull, doubt = interpolate(
            layers[None], (height, width), mode="bilinear", align_corners=False
        )[0]
        inside = torch.sigmoid(border / 0.5)
        inside = torch.where((border > 2) & (hull < -2), _UNSURE_INSIDE, inside)
        return torch.where(border < -2, torch.maximum(inside, doubt), inside)

    found, within = zeros((len(cuts.masks), height, width), device=device), views.inside
    for view, inside in enumerate(side_by_side(enlarged, range(len(cuts.masks)), tracked=False)):
        found[view] = inside.to(device) * within[view]
    return found


# Pixels of each silhouette that are looked at and places on their rays; longer side of the pictures
# in which that is done: choices.
_PIXELS, _PLACES, _SIZE_PX = 100, 64, 320
# Fraction of a silhouette's pixels in conflict, or of the median other's in conflict with it: 0.00
# of true masks (potatoes and mug along an arc, jar and spot on a turntable, balls by hand, 8 to 12
# views of 240x180 and 320x240). Where those of one or two views are wrong, theirs is 0.30 and more
# if they are all of the picture, 0.56 if inverted, 0.86 if a pixel; masks drawn 5 px too wide and 4
# px too narrow in turns are up to 0.22.
_IN_CONFLICT = 0.25


def _in_conflict(
    denied: Bool[Tensor, "view other pixel place"],
    seen: Bool[Tensor, "view other pixel place"],
    chosen: ViewMask,
) -> tuple[Float[Tensor, " view"], Float[Tensor, "view other"]]:
    """Compute the fraction of each view's pixels in conflict, and in conflict with each view.

    Args:
        denied: By each view, places on the rays of each view's pixels; never by that view itself.
        seen: By each view.
        chosen: Views that take part; all others have no conflicts.
    """
    most = chosen.sum() - 1

    def of_view(denied: Tensor, seen: Tensor) -> Tensor:
        denied, seen = (one & chosen[:, None, None] for one in (denied, seen))
        count = torch.where(seen.sum(dim=0) >= 0.5 * most, denied.sum(dim=0), len(chosen))
        fewest = count.amin(dim=-1)
        valid = fewest < len(chosen)
        best = (count == fewest[:, None]) & valid[:, None]
        share = (denied & best).sum(dim=-1) / best.sum(dim=-1).clamp_min(1)
        total = valid.sum().clamp_min(1)
        own = (valid & (fewest > 0)).sum() / total
        return torch.cat([own[None], share.sum(dim=-1) / total])

    found = by_view(of_view, denied, seen) * chosen[:, None]
    return found[:, 0], found[:, 1:]


def contradictory(silhouettes: Silhouettes, cameras: Cameras) -> ViewMask:
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
    denied, seen = _denied(masks, cameras.take(views.tolist()), box)
    left = torch.ones(len(views), dtype=torch.bool)
    while left.sum() >= max(3, len(views) // 2 + 1):
        own, with_others = _in_conflict(denied, seen, left)
        mine = torch.eye(len(left), dtype=torch.bool) | ~left[:, None]
        between = with_others.masked_fill(mine, torch.nan).nanmedian(dim=0).values
        clear = (torch.maximum(own, between) > _IN_CONFLICT) & left
        if not bool(clear.any()):
            doubted = torch.zeros_like(silhouettes.reliable)
            doubted[views[~left]] = True
            return doubted
        involved = (own + with_others.sum(dim=0)).masked_fill(~clear, -1)
        left[involved.argmax()] = False
    return silhouettes.reliable.clone()


def _denied(
    masks: Masks, cameras: Cameras, box_world: Float[Tensor, "2 3"]
) -> tuple[Bool[Tensor, "view other pixel place"], Bool[Tensor, "view other pixel place"]]:
    """Find which views deny, and see, places on rays through pixels of each smaller silhouette."""
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
        # Masks are drawn by hand.
        return seen & (value < -reach - 0.01 * max(height, width)), seen

    shape = len(small), len(small), _PIXELS, _PLACES
    denied, seen = zeros(shape, torch.bool), zeros(shape, torch.bool)
    for view, found in enumerate(side_by_side(followed, range(len(small)), tracked=False)):
        denied[view], seen[view] = found
    return denied, seen


def _places(
    mask: Mask, camera: Cameras, box_world: Float[Tensor, "2 3"]
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
