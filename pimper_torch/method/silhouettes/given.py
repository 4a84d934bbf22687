"""Masks that come with photographs, checked by cameras and points.

Of right masks, rays through the pixels of each meet what all of them leave, points that they show
are in all of them, and views that see another point agree that it is outside. Files may show the
object dark, be turned or mirrored, or belong to other photographs: that reading is taken which
contradicts itself clearly less than the files as they are.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from operator import itemgetter

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torch.nn.functional import grid_sample

from pimper_torch.ground.geometry.opencv import shrunk, signed_distance
from pimper_torch.ground.geometry.pixels import grid_from_pixels, scale_intrinsics
from pimper_torch.ground.geometry.projection import project, rays_through
from pimper_torch.ground.geometry.supporting_plane import well_tracked
from pimper_torch.ground.geometry.visual_hull import bounding_box
from pimper_torch.ground.shapes import Maps, Mask, PerView, ViewMask
from pimper_torch.method.silhouettes.cues import points_at, soft_masks_of
from pimper_torch.records import Cameras, SilhouettePrior, Silhouettes, SparseScene, Views
from pimper_torch.runtime.errors import InputError, caution
from pimper_torch.runtime.mapped import by_view, each, zeros
from pimper_torch.runtime.parallel import side_by_side

# Longer side of the masks that are compared, how many of the points, and places on the rays through
# their pixels: choices.
_SMALL_PX, _POINTS, _PLACES = 320, 4000, 64
_FEWEST = 50  # pairs of points and views; fewer are no evidence
# Of what the files contradict, what another reading may at most; what it may at most in any case;
# what is nothing to mend: docs/decisions.md, "Masks that are turned, inverted or of other
# photographs".
_CLEARLY, _MOST, _LEAST = 1 / 3, 0.05, 0.0025
_REFUSED = 0.5  # of the points in the masks of the median view: more than half; a choice
# Masks that may be exchanged, readings whose pixels are looked at, and views of these: choices.
_SUSPECTS, _TRIED, _VIEWS = 4, 4, 40

Raster = Shaped[Tensor, "_ _"]
Places = Bool[Tensor, "view other pixel place"]
_TURNS = {
    2: "mirrored",
    3: "turned by a half turn",
    4: "mirrored upside down",
    5: "mirrored and turned by a quarter turn",
    6: "turned by a quarter turn anticlockwise",
    7: "mirrored and turned by a quarter turn",
    8: "turned by a quarter turn clockwise",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """How the masks of files show the object.

    Attributes:
        said: What the masks are; completes a sentence.
        inverted: Whether they show the object dark.
        turns: Number, as EXIF's, of the turn that each photograph's mask lacks; none else.
        owners: Photograph under whose name the mask of each is; its own else.
    """

    said: str = ""
    inverted: bool = False
    turns: Mapping[str, int] = field(default_factory=dict)
    owners: Mapping[str, str] = field(default_factory=dict)

    def masks(
        self, maps: Mapping[str, Raster], names: Iterable[str], inverse: Callable[[Raster], Raster]
    ) -> dict[str, Raster]:
        """Return the masks of photographs, of maps without padding by the names of files."""
        found = {}
        for name in names:
            if (owner := self.owners.get(name, name)) in maps:
                one = _turned(maps[owner], self.turns.get(name, 1))
                found[name] = inverse(one) if self.inverted else one
        return found

    def of(self, views: Views) -> Views:
        """Return the photographs with masks and soft masks that are read so."""

        def read(
            names: Sequence[str],
            sizes_px: Tensor,
            maps: Tensor,
            inverse: Callable[[Tensor], Tensor],
        ) -> tuple[tuple[str, ...], Tensor, Tensor]:
            files = {
                name: one[:high, :wide]
                for name, one, (wide, high) in zip(names, maps, sizes_px.tolist(), strict=True)
            }
            found = self.masks(files, dict.fromkeys([*names, *views.names]), inverse)
            shapes = [maps.shape[1:], *(one.shape for one in found.values())]
            size = [max(sides) for sides in zip(*shapes, strict=True)]
            whole = zeros((len(found), *size), maps.dtype, maps.device)
            for into, one in zip(whole, found.values(), strict=True):
                into[: one.shape[0], : one.shape[1]] = one
            return tuple(found), whole, sizes_px.new_tensor([one[::-1] for one in shapes[1:]])

        masks, priors = views.masks, list(views.priors)
        if masks is not None:
            _, masks, _ = read(views.names, views.sizes_px, masks, torch.logical_not)
        for at, prior in enumerate(priors):
            if not isinstance(prior, SilhouettePrior):
                continue
            sized = zip(prior.inside, prior.sizes_px.tolist(), strict=True)
            if not all(points_at(one[:high, :wide]) for one, (wide, high) in sized):
                found = read(prior.names, prior.sizes_px, prior.inside, lambda one: 1 - one)
                names, inside, sizes = found
                priors[at] = prior.replace(names=names, inside=inside, sizes_px=sizes)
        return views.replace(masks=masks, priors=tuple(priors))


AS_THEY_ARE = Reading()


def _turned(one: Raster, turn: int) -> Raster:
    """Turn a map upright that has the orientation of this number of EXIF's."""
    one = one.mT if turn >= 5 else one
    flipped = ((0, (3, 4, 7, 8)), (1, (2, 3, 6, 7)))
    return one.flip([axis for axis, turns in flipped if turn in turns])


def right_reading(scene: SparseScene, given: Views) -> Reading:
    """Find how the masks, or else the soft masks, of a scene are to be read.

    A warning says so where files show something else than their photographs, and where no point
    of the cloud is in the silhouettes.

    Args:
        given: The photographs as they came, also those that found no place.

    Raises:
        InputError: Masks contradict the points, however they are read.
    """
    evidence = _Evidence.of(scene)
    if evidence is None:
        return AS_THEY_ARE
    names = list(evidence.borders)
    some = names[:: math.ceil(len(names) / _VIEWS)]
    pairs, (denied, involved) = evidence.of_points(), evidence.of_pixels(AS_THEY_ARE, some)
    share = evidence.share(pairs, AS_THEY_ARE)
    off = (share + denied) / 2
    if off < _LEAST:
        return AS_THEY_ARE
    by_view = pairs[:, 0] / pairs.sum(dim=1).clamp_min(1)
    suspects = (by_view + involved).argsort(descending=True)[:_SUSPECTS].tolist()
    doubted = [names[view] for view in suspects]
    some = list(dict.fromkeys([*some, *doubted]))
    most = min(_CLEARLY * off, _MOST)
    readings = evidence.readings(given, doubted, ordered=scene.views.poses is None)
    rated = [(evidence.share(evidence.of_points(one, some), one) / 2, one) for one in readings]
    likely = sorted((one for one in rated if one[0] <= most), key=itemgetter(0))[:_TRIED]
    found = [(half + evidence.of_pixels(one, some)[0] / 2, one) for half, one in likely]
    best, reading = min(found, key=itemgetter(0), default=(math.inf, AS_THEY_ARE))
    if best <= most:
        caution(
            f"The masks contradict cameras and points by {off:.1%}, but by {best:.1%} if they are "
            f"{reading.said}, so they are read like that. Correct their files.",
            stacklevel=3,
        )
        return reading
    wrong = float(by_view.median())
    if wrong > _REFUSED and denied > _IN_CONFLICT:
        raise InputError(
            f"The masks contradict {wrong:.0%} of the points in the median view, and one another; "
            f"at most: {_REFUSED:.0%}; also inverted, turned, mirrored or in another order. Look "
            "whether they show the same object in all photographs, and whether the cameras are "
            "those of these; or leave the masks out."
        )
    if share == 1:
        caution(
            "No point of the cloud is in the silhouettes that the masks give. That is right if "
            "the object has no texture; else look whether the masks show it.",
            stacklevel=3,
        )
    return AS_THEY_ARE


def around_and_inside(maps: Sequence[Raster]) -> tuple[float, float]:
    """Return the fractions above zero along the borders of maps, and in their middle halves."""
    around, inside = [], []
    for (one,) in each(maps):
        high, wide = one.shape
        around += [side.gt(0).float().mean() for side in (one[0], one[-1], one[:, 0], one[:, -1])]
        middle = one[high // 4 : -(-3 * high // 4), wide // 4 : -(-3 * wide // 4)]
        inside.append(middle.gt(0).float().mean())
    return float(torch.stack(around).mean()), float(torch.stack(inside).mean())


@dataclass(frozen=True, slots=True, kw_only=True)
class _Evidence:
    """What cameras and points say of masks.

    Attributes:
        borders: Signed distances to the small masks of the files, by the photographs' names.
        pixels: Of the points in the small masks.
        shown: Whether a point is in the frame of a view.
        seen: Whether the view observes it.
    """

    borders: Mapping[str, Raster]
    cameras: Cameras
    pixels: Int[Tensor, "view point 2"]
    shown: Bool[Tensor, "view point"]
    seen: Bool[Tensor, "view point"]

    @classmethod
    def of(cls, scene: SparseScene) -> "_Evidence | None":
        """Gather it; ``None`` where fewer than three masks show anything."""
        views, cameras = scene.views, scene.cameras.to("cpu", torch.float32)
        factor = min(1.0, _SMALL_PX / max(views.images.shape[-2:]))
        sizes = (factor * cameras.sizes_px).round().long().clamp_min(1)
        borders = {}
        if views.masks is not None:
            sized = zip(views.masks, views.sizes_px.tolist(), sizes.tolist(), strict=True)
            for name, (mask, (width, height), size) in zip(views.names, sized, strict=True):
                # A single pixel is a mask, too.
                small = shrunk(mask[None, :height, :width].cpu().float(), *size)[0] > 0
                if bool(small.any()):
                    borders[name] = signed_distance(small)
        elif soft := soft_masks_of(views, sizes):
            for view in (soft.given & soft.masks.flatten(1).any(dim=1)).nonzero()[:, 0].tolist():
                wide, high = sizes[view].tolist()
                borders[views.names[view]] = signed_distance(soft.masks[view, :high, :wide])
        if len(borders) < 3:
            return None
        chosen, tracked = list(map(views.names.index, borders)), well_tracked(scene).cpu()
        some = tracked.nonzero()[:, 0][:: math.ceil((int(tracked.sum()) + 1) / _POINTS)]
        intrinsics = scale_intrinsics(cameras.intrinsics, factor, factor)
        cameras = cameras.replace(intrinsics=intrinsics, sizes_px=sizes).take(chosen)
        points = scene.points_world.detach().cpu().float()[some]
        pixels, depth = project(points, cameras.cam_from_world, cameras.intrinsics)
        shown = ((pixels > 0) & (pixels < cameras.sizes_px[:, None])).all(dim=-1) & (depth > 0)
        return cls(
            borders=borders,
            cameras=cameras,
            pixels=torch.where(shown[..., None], pixels, 0).long(),
            shown=shown,
            seen=scene.observed.cpu()[some].mT[chosen] & shown,
        )

    def readings(self, views: Views, doubted: Sequence[str], *, ordered: bool) -> Iterator[Reading]:
        """List what files may show in place of the photographs' own masks.

        Args:
            doubted: Photographs of which two may have each other's masks.
            ordered: Whether photographs may have masks of other ones.
        """
        names = views.names
        around, inside = around_and_inside(list(self.borders.values()))
        # An object that fills its photographs is in their middle, too.
        if inside < 0.75 < around:
            yield Reading(said="inverted", inverted=True)
        alike = ordered and bool((views.sizes_px == views.sizes_px[0]).all())
        for one, other in combinations(doubted, 2) if alike else ():
            said = f"exchanged between {one} and {other}"
            yield Reading(said=said, owners={one: other, other: one})
        square = bool((views.sizes_px[:, 0] == views.sizes_px[:, 1]).all())
        for turn, said in _TURNS.items():
            if turn < 5 or square:
                yield Reading(said=said, turns=dict.fromkeys(names, turn))
        if views.orientations is not None:
            told = zip(names, views.orientations.tolist(), strict=True)
            turns = {name: turn for name, turn in told if turn < 5 or square}
            yield Reading(said="of the pixels that files store, not turned by EXIF", turns=turns)
        for step in range(1, len(names)) if alike else ():
            owners = dict(zip(names, (*names[step:], *names[:step]), strict=True))
            said = f"shifted by {step} in the list ({names[0]} has that of {names[step]})"
            yield Reading(said=said, owners=owners)

    def read(self, reading: Reading, names: Iterable[str]) -> tuple[list[int], Maps]:
        """Return the views, of those named, whose mask a reading has, and distances to these."""
        found = reading.masks(self.borders, names, torch.neg)
        high, wide = self.cameras.sizes_px.amax(dim=0).flip(0).tolist()
        maps = torch.full((len(found), high, wide), -1e3)
        for into, one in zip(maps, found.values(), strict=True):
            into[: one.shape[0], : one.shape[1]] = one
        every = list(self.borders)
        return [every.index(name) for name in found], maps

    def of_points(
        self, reading: Reading = AS_THEY_ARE, names: Sequence[str] = ()
    ) -> Int[Tensor, "view 2"]:
        """Count, in each view, pairs with points that contradict a reading, and that confirm it.

        A point is the object's where most views that observe it show it inside. Then it is inside
        in all views, or else outside in all that observe it; masks are drawn by hand.

        Args:
            names: Of the views that are compared; all by default.
        """
        views, maps = self.read(reading, names or self.borders)
        column, row = self.pixels[views].unbind(dim=-1)
        value = maps[torch.arange(len(views))[:, None], row, column]
        seen, shown, margin = self.seen[views], self.shown[views], 0.01 * max(maps.shape[1:])
        own = 2 * (seen & (value > 0)).sum(dim=0) > seen.sum(dim=0)
        wrong = (shown & own & (value < -margin)) | (seen & ~own & (value > margin))
        right = shown & own & (value >= -margin)
        return torch.stack([wrong.sum(dim=1), right.sum(dim=1)], dim=1)

    def share(self, pairs: Int[Tensor, "view 2"], reading: Reading) -> float:
        """Return the fraction of pairs that contradict; 1 where hardly any point is in the masks.

        An object without texture has no points: inverted masks need not show any. A cloud with
        hardly any point contradicts nothing.
        """
        wrong, total = int(pairs[:, 0].sum()), int(pairs.sum())
        if int(self.seen.sum()) < _FEWEST:
            return 0.0
        if total < _FEWEST:
            return _MOST if reading.inverted else 1.0
        return wrong / total

    def of_pixels(self, reading: Reading, names: Sequence[str]) -> tuple[float, PerView]:
        """Return the fraction of the masks' pixels that others deny, and how each takes part in it.

        Args:
            names: Of the views that are compared.
        """
        views, maps = self.read(reading, names)
        involved = torch.zeros(len(self.borders))
        found = _denied(maps, self.cameras.take(views), 40)
        if found is None:
            return 1.0, involved
        own, with_others = _in_conflict(*found, torch.ones(len(views), dtype=torch.bool))
        involved[views] = own + with_others.sum(dim=0)
        return float(own.mean()), involved


# Fraction of a silhouette's pixels in conflict, or of the median other's in conflict with it: 0.00
# of true masks (potatoes and mug along an arc, jar and spot on a turntable, balls by hand, 8 to 12
# views of 240x180 and 320x240). Where those of one or two views are wrong, theirs is 0.30 and more
# if they are all of the picture, 0.56 if inverted, 0.86 if a pixel; masks drawn 5 px too wide and 4
# px too narrow in turns are up to 0.22.
_IN_CONFLICT = 0.25


def _in_conflict(
    denied: Places, seen: Places, chosen: ViewMask
) -> tuple[PerView, Float[Tensor, "view other"]]:
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


def contradictory(scene: SparseScene) -> ViewMask:
    """Find the views whose masks clearly contradict those of the others.

    Returns:
        All that show anything where fewer than three, or no more than half, would agree.
    """
    doubted = torch.zeros(scene.views.num_views, dtype=torch.bool)
    evidence = _Evidence.of(scene)
    if evidence is None:
        return doubted
    _, maps = evidence.read(AS_THEY_ARE, evidence.borders)
    found = _denied(maps, evidence.cameras, 100)
    if found is None:
        return doubted
    views = torch.tensor(list(map(scene.views.names.index, evidence.borders)))
    left = torch.ones(len(views), dtype=torch.bool)
    while left.sum() >= max(3, len(views) // 2 + 1):
        own, with_others = _in_conflict(*found, left)
        mine = torch.eye(len(left), dtype=torch.bool) | ~left[:, None]
        between = with_others.masked_fill(mine, torch.nan).nanmedian(dim=0).values
        clear = (torch.maximum(own, between) > _IN_CONFLICT) & left
        if not bool(clear.any()):
            doubted[views[~left]] = True
            return doubted
        involved = (own + with_others.sum(dim=0)).masked_fill(~clear, -1)
        left[involved.argmax()] = False
    doubted[views] = True
    return doubted


def _denied(borders: Maps, cameras: Cameras, count: int) -> tuple[Places, Places] | None:
    """Find which views deny, and see, places on rays through pixels of each mask.

    Args:
        borders: Signed distances to the masks.
        count: Pixels of each.

    Returns:
        ``None`` where a mask shows nothing.
    """
    masks, views = borders > 0, range(len(borders))
    shown = Silhouettes(inside=masks.float(), reliable=masks.flatten(1).any(dim=1), source="masks")
    box = bounding_box(shown, cameras)
    if box is None or not bool(shown.reliable.all()):
        return None

    def followed(view: int) -> tuple[Tensor, Tensor]:
        places, step = _places(masks[view], cameras.take([view]), box, count)
        pixels, depth = project(places, cameras.cam_from_world, cameras.intrinsics)
        pixels = pixels.reshape(len(masks), -1, _PLACES, 2)
        depth = depth.reshape(len(masks), -1, _PLACES)
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

    denied, seen = (zeros((len(views), len(views), count, _PLACES), torch.bool) for _ in range(2))
    for view, found in enumerate(side_by_side(followed, views, tracked=False)):
        denied[view], seen[view] = found
    return denied, seen


def _places(
    mask: Mask, camera: Cameras, box_world: Float[Tensor, "2 3"], count: int
) -> tuple[Float[Tensor, "place 3"], Float[Tensor, " pixel"]]:
    """List places in the box on rays through pixels of a mask, and half of the way between them."""
    shown = mask.nonzero()
    shown = shown[torch.linspace(0, len(shown) - 1, count).round().long()]
    rays = rays_through(shown.flip(1).float() + 0.5, camera.cam_from_world[0], camera.intrinsics[0])
    eye = camera.centers_world[0]
    ends = (box_world[:, None] - eye) / torch.where(rays.abs() > 1e-9, rays, 1e-9)
    near = ends.amin(dim=0).amax(dim=-1).clamp_min(0)
    far = torch.maximum(ends.amax(dim=0).amin(dim=-1), near)
    along = near[:, None] + (far - near)[:, None] * torch.linspace(0, 1, _PLACES)
    half = (far - near) * rays.norm(dim=-1) / (2 * (_PLACES - 1))
    return (eye + along[..., None] * rays[:, None]).flatten(0, 1), half
