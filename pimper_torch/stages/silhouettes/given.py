"""Given masks, checked against cameras and points.

If masks are correct, rays through the pixels of each mask meet a point that no mask excludes,
points in one mask are in all of them, and views that observe any other point agree that it is
outside. Files may show the object dark, be turned or mirrored, or belong to other photographs. They
are refused if such a reading contradicts itself clearly less than the files as they are.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from heapq import nsmallest
from itertools import combinations
from operator import itemgetter
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample

from pimper_torch.geometry.mask_polarity import Raster, around_and_inside
from pimper_torch.geometry.opencv import area_resized, signed_distance
from pimper_torch.geometry.pixels import grid_from_pixels, pixels_from_indices, scale_intrinsics
from pimper_torch.geometry.projection import project, rays_through
from pimper_torch.geometry.supporting_plane import well_tracked
from pimper_torch.geometry.visual_hull import bounding_cube
from pimper_torch.records import Cameras, Silhouettes, SparseScene, Views
from pimper_torch.records.shapes import Maps, Mask, PerView, ViewMask
from pimper_torch.runtime.errors import InputError, caution
from pimper_torch.runtime.mapped import by_view, zeros
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.stages.silhouettes.cues import soft_masks_of

# Longer side of the compared masks, number of points, and samples on each ray through their pixels:
# choices.
_SMALL_PX, _POINTS, _PLACES = 320, 4000, 64
_FEWEST = 50  # pairs of points and views needed as evidence
# Most contradiction of an alternative reading, relative to that of the files and absolute; and the
# contradiction below which the files are accepted: docs/decisions.md, "Masks that are turned,
# inverted or of other photographs".
_CLEARLY, _MOST, _LEAST = 1 / 3, 0.05, 0.0025
_REFUSED = 0.5  # of the points in the masks of the median view; a choice
# Most exchangeable masks, readings whose pixels are compared, and views for that: choices.
_SUSPECTS, _TRIED, _VIEWS = 4, 4, 40

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
_UPRIGHT = "masks that are oriented like the photographs. Turn or mirror the files accordingly."
_NAMED = "masks named after the photographs that they show. Rename the files."


class _Reading(NamedTuple):
    """Signed distances to small masks, by photograph; what the files are then; what is needed.

    ``bare`` is the fraction of contradicting points if its masks contain hardly any.
    """

    borders: Mapping[str, Raster]
    cause: str
    needed: str
    bare: float = 1.0


def _turned(mask: Raster, turn: int) -> Raster:
    """Return a map turned upright from an EXIF orientation, or itself if its shape would change."""
    turned = mask.mT if turn >= 5 else mask
    flipped = ((0, (3, 4, 7, 8)), (1, (2, 3, 6, 7)))
    fits = turned.shape == mask.shape
    return turned.flip([axis for axis, turns in flipped if turn in turns]) if fits else mask


def refuse_wrong_masks(scene: SparseScene, names: Sequence[str]) -> None:
    """Refuse the masks, or else the soft masks, of a scene that cameras and points contradict.

    A warning is given if no point of the cloud is in the silhouettes.

    Args:
        names: All photographs in their order, including unregistered ones.

    Raises:
        InputError: The files are inverted, turned, mirrored, exchanged or shifted in the list, or
            contradict the points in every reading.
    """
    evidence = _Evidence.of(scene)
    if evidence is None:
        return
    files, known = evidence.borders, list(evidence.borders)
    compared = known[:: math.ceil(len(known) / _VIEWS)]
    share, by_view = evidence.of_points(files)
    denied, involved = evidence.of_pixels({name: files[name] for name in compared})
    contradiction = (share + denied) / 2
    if contradiction < _LEAST:
        return
    worst = (by_view + involved).argsort(descending=True)[:_SUSPECTS].tolist()
    suspects = [known[view] for view in worst]
    most = min(_CLEARLY * contradiction, _MOST)
    files = {name: files[name] for name in (*compared, *suspects)}
    readings = evidence.readings(scene.views, names, files, suspects)
    rated = ((evidence.of_points(one.borders, one.bare)[0] / 2, one) for one in readings)
    likely = nsmallest(_TRIED, (pair for pair in rated if pair[0] <= most), key=itemgetter(0))
    totals = [(half + evidence.of_pixels(one.borders)[0] / 2, one) for half, one in likely]
    best, reading = min(totals, key=itemgetter(0), default=(math.inf, None))
    if reading is not None and best <= most:
        raise InputError(
            f"The masks contradict cameras and points by {contradiction:.1%}, but by {best:.1%} if "
            f"they are {reading.cause}. Needed: {reading.needed}"
        )
    refused = float(by_view.median())
    if refused > _REFUSED and denied > _IN_CONFLICT:
        raise InputError(
            f"The masks contradict {refused:.0%} of the points in the median view, and each other; "
            f"at most: {_REFUSED:.0%}. Inverting, turning, mirroring or reordering them does not "
            "help. Check whether they show the same object in all photographs, and whether the "
            "cameras belong to these photographs; or omit the masks."
        )
    if share == 1:
        caution(
            "No point of the cloud is in the silhouettes of the masks. This is correct if the "
            "object has no texture; otherwise check that the masks show it.",
            stacklevel=3,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Evidence:
    """Evidence about masks from cameras and points.

    Attributes:
        borders: Signed distances to the small masks of the files, by photograph name.
        pixels: Of the points in the small masks.
        in_frame: Whether a point projects into the frame of a view.
        observed: Whether the view observes it.
    """

    borders: Mapping[str, Raster]
    cameras: Cameras
    pixels: Int[Tensor, "view point 2"]
    in_frame: Bool[Tensor, "view point"]
    observed: Bool[Tensor, "view point"]

    @classmethod
    def of(cls, scene: SparseScene) -> "_Evidence | None":
        """Gather the evidence; ``None`` if fewer than three masks contain a pixel."""
        views, cameras = scene.views, scene.cameras.to("cpu", torch.float32)
        factor = min(1.0, _SMALL_PX / max(views.images.shape[-2:]))
        sizes = (factor * cameras.sizes_px).round().long().clamp_min(1)
        borders = {}
        if views.masks is not None:
            sized = zip(views.masks, views.sizes_px.tolist(), sizes.tolist(), strict=True)
            for name, (mask, (width, height), size) in zip(views.names, sized, strict=True):
                # Keep masks of a single pixel.
                small = area_resized(mask[None, :height, :width].cpu().float(), *size)[0] > 0
                if bool(small.any()):
                    borders[name] = signed_distance(small)
        elif soft := soft_masks_of(views, sizes):
            for view in (soft.given & soft.masks.flatten(1).any(dim=1)).nonzero()[:, 0].tolist():
                wide, high = sizes[view].tolist()
                borders[views.names[view]] = signed_distance(soft.masks[view, :high, :wide])
        if len(borders) < 3:
            return None
        chosen, tracked = list(map(views.names.index, borders)), well_tracked(scene).cpu()
        sampled = tracked.nonzero()[:, 0][:: math.ceil((int(tracked.sum()) + 1) / _POINTS)]
        intrinsics = scale_intrinsics(cameras.intrinsics, factor, factor)
        cameras = cameras.replace(intrinsics=intrinsics, sizes_px=sizes).take(chosen)
        points = scene.points_world.detach().cpu().float()[sampled]
        pixels, depth = project(points, cameras.cam_from_world, cameras.intrinsics)
        in_frame = ((pixels > 0) & (pixels < cameras.sizes_px[:, None])).all(dim=-1) & (depth > 0)
        return cls(
            borders=borders,
            cameras=cameras,
            pixels=torch.where(in_frame[..., None], pixels, 0).long(),
            in_frame=in_frame,
            observed=scene.observed.cpu()[sampled].mT[chosen] & in_frame,
        )

    def readings(
        self,
        views: Views,
        names: Sequence[str],
        files: Mapping[str, Raster],
        suspects: Iterable[str],
    ) -> Iterator[_Reading]:
        """List possible readings of files; two of the suspects may have each other's masks."""
        around, inside = around_and_inside(list(files.values()))
        # An object that fills its photographs covers their middle.
        if inside < 0.75 < around:
            option = "" if views.masks is None else ", or give `--mask-object dark`"
            needed = f"masks that are bright at the object. Invert the files{option}."
            inverted = {name: -mask for name, mask in files.items()}
            # An object without texture has no points.
            yield _Reading(inverted, "inverted: they show the object dark", needed, bare=_MOST)
        ordered = views.poses is None
        for first, second in combinations(suspects, 2) if ordered else ():
            swapped = {**files, first: files[second], second: files[first]}
            yield _Reading(swapped, f"exchanged between {first} and {second}", _NAMED)
        turns = [(dict.fromkeys(files, turn), cause) for turn, cause in _TURNS.items()]
        if views.orientations is not None:
            exif = dict(zip(views.names, views.orientations.tolist(), strict=True))
            turns.append((exif, "in the stored orientation, not turned by EXIF"))
        for turn, cause in turns:
            turned = {name: _turned(mask, turn[name]) for name, mask in files.items()}
            yield _Reading(turned, cause, _UPRIGHT)
        for step in range(1, len(names)) if ordered else ():
            owners = zip(names, (*names[step:], *names[:step]), strict=True)
            shifted = {x: self.borders[y] for x, y in owners if x in files and y in self.borders}
            cause = f"shifted by {step} in the list ({names[0]} has that of {names[step]})"
            if 2 * len(shifted) > len(files):
                yield _Reading(shifted, cause, _NAMED)

    def padded(self, borders: Mapping[str, Raster]) -> tuple[list[int], Maps]:
        """Return the positions of the named views, and their signed distances as one raster."""
        high, wide = self.cameras.sizes_px.amax(dim=0).flip(0).tolist()
        maps = torch.full((len(borders), high, wide), -1e3)
        for into, x in zip(maps, borders.values(), strict=True):
            into[: x.shape[0], : x.shape[1]] = x
        known = list(self.borders)
        return [known.index(name) for name in borders], maps

    def of_points(self, borders: Mapping[str, Raster], bare: float = 1.0) -> tuple[float, PerView]:
        """Return the fraction of pairs of points and views that contradict masks, also by view.

        A point inside most masks of the views that observe it must be inside in all views, any
        other one outside in all that observe it. The margin allows for masks drawn by hand. A cloud
        with hardly any observed point contradicts nothing.

        Args:
            bare: Fraction if masks contain hardly any point.
        """
        views, maps = self.padded(borders)
        column, row = self.pixels[views].unbind(dim=-1)
        value = maps[torch.arange(len(views))[:, None], row, column]
        seen, framed = self.observed[views], self.in_frame[views]
        margin = 0.01 * max(maps.shape[1:])
        inside = 2 * (seen & (value > 0)).sum(dim=0) > seen.sum(dim=0)
        contradicts = (framed & inside & (value < -margin)) | (seen & ~inside & (value > margin))
        wrong = contradicts.sum(dim=1)
        pairs = wrong + (framed & inside & (value >= -margin)).sum(dim=1)
        share = bare if pairs.sum() < _FEWEST else float(wrong.sum() / pairs.sum())
        return share if self.observed.sum() >= _FEWEST else 0.0, wrong / pairs.clamp_min(1)

    def of_pixels(self, borders: Mapping[str, Raster]) -> tuple[float, PerView]:
        """Return the fraction of masks' pixels in conflict, and each view's involvement."""
        views, maps = self.padded(borders)
        involved = torch.zeros(len(self.borders))
        samples = _denied(maps, self.cameras.take(views), 40)
        if samples is None:
            return 1.0, involved
        conflict, with_others = _in_conflict(*samples, torch.ones(len(views), dtype=torch.bool))
        involved[views] = conflict + with_others.sum(dim=0)
        return float(conflict.mean()), involved


# Fraction of a silhouette's pixels in conflict, or of the median other's in conflict with it: 0.00
# for true masks (potatoes and mug along an arc, jar and spot on a turntable, balls by hand, 8 to 12
# views of 240x180 and 320x240). If those of one or two views are wrong, theirs is 0.30 and more for
# masks of the full image, 0.56 for inverted ones, 0.86 for a single pixel; masks drawn alternately
# 5 px too wide and 4 px too narrow have up to 0.22.
_IN_CONFLICT = 0.25


def _in_conflict(
    denied: Places, seen: Places, chosen: ViewMask
) -> tuple[PerView, Float[Tensor, "view other"]]:
    """Compute the fraction of each view's pixels in conflict, and in conflict with each view.

    Args:
        denied: Samples on the rays of each view's pixels that each view denies; never itself.
        seen: Samples that each view sees.
        chosen: Views that take part; the others have no conflicts.
    """
    most = chosen.sum() - 1

    def of_view(denied: Tensor, seen: Tensor) -> Tensor:
        denied, seen = (x & chosen[:, None, None] for x in (denied, seen))
        count = torch.where(seen.sum(dim=0) >= 0.5 * most, denied.sum(dim=0), len(chosen))
        fewest = count.amin(dim=-1)
        valid = fewest < len(chosen)
        best = (count == fewest[:, None]) & valid[:, None]
        share = (denied & best).sum(dim=-1) / best.sum(dim=-1).clamp_min(1)
        total = valid.sum().clamp_min(1)
        conflict = (valid & (fewest > 0)).sum() / total
        return torch.cat([conflict[None], share.sum(dim=-1) / total])

    fractions = by_view(of_view, denied, seen) * chosen[:, None]
    return fractions[:, 0], fractions[:, 1:]


def contradictory(scene: SparseScene) -> ViewMask:
    """Return the views whose masks clearly contradict the others.

    Returns:
        All views with a mask if fewer than three, or at most half, would agree.
    """
    rejected = torch.zeros(scene.views.num_views, dtype=torch.bool)
    evidence = _Evidence.of(scene)
    if evidence is None:
        return rejected
    _, maps = evidence.padded(evidence.borders)
    samples = _denied(maps, evidence.cameras, 100)
    if samples is None:
        return rejected
    views = torch.tensor(list(map(scene.views.names.index, evidence.borders)))
    kept = torch.ones(len(views), dtype=torch.bool)
    while kept.sum() >= max(3, len(views) // 2 + 1):
        conflict, with_others = _in_conflict(*samples, kept)
        excluded = torch.eye(len(kept), dtype=torch.bool) | ~kept[:, None]
        typical = with_others.masked_fill(excluded, torch.nan).nanmedian(dim=0).values
        clear = (torch.maximum(conflict, typical) > _IN_CONFLICT) & kept
        if not bool(clear.any()):
            rejected[views[~kept]] = True
            return rejected
        involved = (conflict + with_others.sum(dim=0)).masked_fill(~clear, -1)
        kept[involved.argmax()] = False
    rejected[views] = True
    return rejected


def _denied(borders: Maps, cameras: Cameras, count: int) -> tuple[Places, Places] | None:
    """Return which views deny, and which see, samples on rays through pixels of each mask.

    Args:
        borders: Signed distances to the masks.
        count: Pixels per mask.

    Returns:
        ``None`` if a mask is empty.
    """
    masks, views = borders > 0, range(len(borders))
    given = Silhouettes(inside=masks.float(), reliable=masks.flatten(1).any(dim=1), source="masks")
    box = bounding_cube(given, cameras)
    if box is None or not bool(given.reliable.all()):
        return None

    def samples_of(view: int) -> tuple[Tensor, Tensor]:
        positions, step = _places(masks[view], cameras.take([view]), box, count)
        pixels, depth = project(positions, cameras.cam_from_world, cameras.intrinsics)
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
        # The tolerance allows for masks drawn by hand.
        return seen & (value < -reach - 0.01 * max(height, width)), seen

    denied, seen = (zeros((len(views), len(views), count, _PLACES), torch.bool) for _ in range(2))
    for view, samples in enumerate(side_by_side(samples_of, views, tracked=False)):
        denied[view], seen[view] = samples
    return denied, seen


def _places(
    mask: Mask, camera: Cameras, box_world: Float[Tensor, "2 3"], count: int
) -> tuple[Float[Tensor, "place 3"], Float[Tensor, " pixel"]]:
    """Return samples in the box on rays through a mask's pixels, and half their spacing."""
    pixels = pixels_from_indices(mask.nonzero().flip(1).float())
    pixels = pixels[torch.linspace(0, len(pixels) - 1, count).round().long()]
    rays = rays_through(pixels, camera.cam_from_world[0], camera.intrinsics[0])
    eye = camera.centers_world[0]
    ends = (box_world[:, None] - eye) / torch.where(rays.abs() > 1e-9, rays, 1e-9)
    near = ends.amin(dim=0).amax(dim=-1).clamp_min(0)
    far = torch.maximum(ends.amax(dim=0).amin(dim=-1), near)
    along = near[:, None] + (far - near)[:, None] * torch.linspace(0, 1, _PLACES)
    half = (far - near) * rays.norm(dim=-1) / (2 * (_PLACES - 1))
    return (eye + along[..., None] * rays[:, None]).flatten(0, 1), half
