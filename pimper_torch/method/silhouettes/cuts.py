"""Alternate cuts of every view with a vote of all views on their visual hull.

Cuts start from labels that are certain: of points, of parallax and, after a vote, of the hull.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from pimper_torch.ground.geometry.opencv import (
    BACKGROUND,
    OBJECT,
    PERHAPS_BACKGROUND,
    PERHAPS_OBJECT,
    blind_holes,
    closed,
    components_of,
    convex_hull_of,
    dilated,
    discs_at,
    grab_cut,
    grab_cut_halved,
    opened,
    signed_distance,
    without_specks,
)
from pimper_torch.ground.geometry.visual_hull import margins, visual_hull
from pimper_torch.ground.shapes import Map, Maps, Mask, Masks, PerView, Pixels, Scalar, ViewMask
from pimper_torch.method.silhouettes.cues import FEW, MIN_POINTS, Cues, keep_seeded_components
from pimper_torch.method.silhouettes.parallax import DISPUTED, of_views
from pimper_torch.records import Record, Silhouettes
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.mapped import by_view

# Chosen on the four rendered scenes and the skull (benchmarks/silhouettes.py).
_ITERATIONS = 2  # of cutting and voting after the first cut
NUM_VOXELS = 500_000  # of the hull
_DISAGREEING = 0.05  # fraction of the views that may see a voxel of the hull outside

# Fractions of the views that may lack what the others have in common, tried in turn after that
# until it takes so much of a median mask; a mask that shows less than this of it is of something
# else.
_MORE_DISAGREEING, _COMMON, _HELD = (0.15, 0.3, 0.45), 0.2, 0.5

# Lengths are fractions of the pictures' longer side.
_DISC = 1 / 400  # about a point: its feature is larger, but may reach over the silhouette
_CLOSING = 1 / 90
_DEEP = 1 / 50  # parallax this far inside the projection tells object
_THIN = 1 / 200  # and this far in the middle of a part that is nowhere so deep
_MIDDLE = 0.7  # of the depth of such a part: a body's legs and handle are seeded, no shadow is

# Agreement with neighbours moved by the plane: below is not the plane, above is.
_OFF_PLANE = 0.4
_NOT_PLANE = 0.6
_ON_PLANE = 0.75
_THROUGH = 0.2  # of a hole: its border agrees with nothing

# Log radiance below that of a cut's median from which on what the hull denies is a shadow: a half.
# Of such pieces of armadillo, ogre and spot under a hard lamp, 150 of 161 of shadow are darker, and
# 17 of 90 of the object.
_SHADOW = 0.7

# Probability that a pixel which a cut lacks shows the object: where it contradicts the plane, and
# where it only does not agree. Under a hard lamp (spot and ogre, 30 views all round) 67 and 61 % of
# what cuts lack wrongly contradicts it, 15 and 20 % of the rest; 2 and 1, 48 and 46 % agree.
DOUBT_OFF_PLANE, _DOUBT = 0.375, 0.25

Cutter = Callable[[Tensor, Tensor, int], Tensor]  # grab_cut, or one like it
Labels = UInt8[Tensor, "height width"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Cuts(Record):
    """The object in every view, as the view itself and as all together have it.

    Attributes:
        margins_px: Inside the projection of the hull, pixels of the working size.
        exposed: Fraction of each cut that shows a background for certain.
        held: Fraction of the object's points that each cut holds.
        doubted: Views whose soft mask was not used.
        agreement: With the backgrounds; ``None`` without any.
        hidden: Pixels of the cuts that show something in front of the object; ``None`` for none.
    """

    masks: Masks
    margins_px: Maps
    exposed: PerView
    held: PerView
    doubted: ViewMask
    agreement: Maps | None
    hidden: Masks | None = None


def cut_in_iterations(cues: Cues) -> Cuts | None:
    """Cut every view, vote, and cut again from what the vote says.

    Before every vote the plane's texture is learned anew where the cuts do not hide it: holes
    that it is seen through stay open, and what stands before it stands out. Where parallax alone
    cut, views abstain from the first vote beyond the plane.

    Returns:
        ``None`` where the cuts have nothing in common.
    """
    masks, unknown = _first(cues), torch.zeros_like(cues.pictures.grey, dtype=torch.bool)
    if cues.agreement is not None and not cues.has_points:
        unknown = by_view(Tensor.isnan, cues.agreement)  # as beyond the plane
    doubted = _doubted(cues, masks)
    cues, voting = cues.without(doubted)
    for _ in range(_ITERATIONS):
        cues, masks, hidden = _compared(cues, masks)
        abstain = by_view(torch.bitwise_or, unknown, hidden)
        seen = _voted(cues, by_view(Tensor.float, masks).masked_fill_(abstain, 0.5), voting)
        if seen is None:
            return None
        cues, voting = cues.seen_in(seen), None
        masks, unknown = _again(cues, masks, seen, unknown), torch.zeros_like(unknown)
    cues, masks, hidden = _compared(cues, masks)
    shown = by_view(Tensor.float, masks)  # the probability of the object
    if cues.agreement is not None:
        shown = by_view(lambda mask, at: torch.where(mask, 1, doubt_of(at)), masks, cues.agreement)
    seen = _voted(cues, shown.masked_fill_(hidden, 0.5))
    if seen is None:
        return None
    masks = repaired(masks, seen, None if cues.plane is None else cues.pictures.grey)
    hidden = by_view(lambda at, margin: at & (margin > 0), hidden, seen)
    masks = by_view(torch.bitwise_or, masks, hidden)
    found = cuts_of(cues.seen_in(seen), masks, seen, doubted)
    return found.replace(hidden=hidden) if bool(hidden.any()) else found


def cuts_of(cues: Cues, masks: Masks, margins_px: Maps, doubted: ViewMask) -> Cuts:
    """Compare cuts with backgrounds and points."""
    views = len(masks)
    return Cuts(
        masks=masks,
        margins_px=margins_px,
        exposed=of_views(lambda at: exposed_fraction(masks[at], cues.agreement_in(at)), views),
        held=of_views(lambda at: held_fraction(masks[at], cues.object_px[at]), views),
        doubted=doubted,
        agreement=cues.agreement,
    )


def repaired(masks: Masks, margins_px: Maps, grey: Maps | None) -> Masks:
    """Repair cuts that the hull denies: shadows taken in, or highlights left out.

    A supporting plane shows shadows, and what is seen through a hole is known there
    (:func:`filled`); without a plane the hull tells of holes.

    Args:
        grey: Logarithm of the mean radiance; ``None`` without a plane.
    """
    if grey is None:
        # Next to a skull's cheek bone views see through what is half as deep.
        return by_view(
            lambda mask, margin: mask | blind_holes(mask, ~is_deep(margin / 2.0), 0.2),
            masks,
            margins_px,
        )
    found = by_view(_without_shadow, masks, margins_px, grey)
    leave_out("silhouettes.shadows", masks & ~found)
    return found


def _without_shadow(mask: Mask, margin: Map, grey: Map) -> Mask:
    """Take from a cut what the hull denies and is dark, as shadows on the plane are.

    They move with the light, so that other views see the plane there. What is as bright as the rest
    of the object stays: the hull may have lost it, or the camera be misplaced. Of an object that is
    itself darker than half of its surroundings, brighter pixels alone stay.
    """
    shown, far = grey[mask & (margin > 0)], 1 / 200 * max(mask.shape)
    if len(shown) == 0:
        return mask
    dark, around = shown.median() - _SHADOW, grey[~mask].median() - _SHADOW
    if shown.median() < around:
        dark = around
    shadow = mask & (margin < -far / 2) & (grey < dark)
    return mask & ~components_of(shadow, margin < -far)


def _compared(cues: Cues, masks: Masks) -> tuple[Cues, Masks, Masks]:
    """Learn the backgrounds' texture anew where cuts do not hide it, and compare them with it.

    Returns:
        The cues, the cuts with their holes filled, and what may hide the object in each view, so
        that its cut says nothing there.
    """
    cues = cues.relearned(masks)
    agreement = cues.agreement
    if agreement is None:
        return cues, masks, torch.zeros_like(masks)
    whole = of_views(lambda view: filled(masks[view], agreement[view]), len(masks))
    hidden = of_views(lambda view: occluder_mask(whole[view], agreement[view]), len(masks))
    return cues, whole, hidden


def _first(cues: Cues) -> Masks:
    """Cut from points and parallax; by parallax alone in front of a room, or with few points.

    Every other pixel is enough: all are cut again. Soft masks need no cut, but for the plane.
    """
    height, width = cues.pictures.grey.shape[1:]

    def first(view: int) -> Mask:
        object_px = cues.object_px[view]
        agreement = cues.agreement_in(view)
        if cues.soft is not None and cues.soft.given[view]:
            mask = cues.soft.masks[view]
            return mask if agreement is None else mask & ~surely_on_plane(agreement)
        if agreement is not None and (cues.all_round or not cues.has_points):
            return off_plane_mask(agreement) | not_seen_through(object_px, agreement)
        labels = labels_from_points(object_px, cues.background_px[view], agreement, (width, height))
        margin = signed_distance(convex_hull_of(object_px, (width, height)))
        return _cut(grab_cut_halved, cues, view, labels, margin)

    return of_views(first, cues.num_views)


def _again(cues: Cues, masks: Masks, seen: Maps, unknown: Masks) -> Masks:
    """Cut from the last cut and the hull; drop what does not meet the hull."""

    def again(view: int) -> Mask:
        points = cues.object_px[view], cues.agreement_in(view)
        labels = labels_from_hull(seen[view], masks[view], *points, unknown[view])
        if cues.soft is not None and cues.soft.given[view]:
            labels = labels_from_soft(labels, cues.soft.masks[view], seen[view])
        cut = _cut(grab_cut, cues, view, labels, seen[view])
        return without_specks(cut, seen[view] > 0, round(2e-4 * cut.numel()))

    return of_views(again, cues.num_views)


def _cut(how: Cutter, cues: Cues, view: int, labels: Labels, margin: Map) -> Mask:
    """Cut a view, by colours that shadows change little where there is a plane for them to fall on.

    Those do not distinguish the grey inside of a vessel from a grey table: pixels well inside are
    the object's unless the plane is seen there.
    """
    if cues.agreement is None:
        return how(cues.pictures.opponent[view], labels, 2)
    agreement = cues.agreement[view]
    surrounded = not_seen_through(cues.object_px[view], agreement)
    surrounded &= ~(agreement >= DISPUTED)
    labels = torch.where(is_deep(margin / 2.0) & surrounded, OBJECT, labels)
    return how(cues.pictures.opponent[view], labels, 2)


def _doubted(cues: Cues, masks: Masks) -> ViewMask:
    """Find soft masks that lack most of what most of them have in common; all if that is little."""
    if cues.soft is None or int(cues.soft.given.sum()) < FEW:
        return torch.zeros(len(masks), dtype=torch.bool)
    given = cues.soft.given
    for disagreeing in (_DISAGREEING, *_MORE_DISAGREEING):
        seen = _voted(cues, masks.float(), given, disagreeing)
        if seen is not None:
            common = seen > 0
            shown, own = (one.sum(dim=(1, 2)).clamp_min(1) for one in (common, masks))
            if (shown / own)[given].median() >= _COMMON:
                return given & ((masks & common).sum(dim=(1, 2)) < _HELD * shown)
    return given


def doubt_of(agreement: Map) -> Map:
    """Return the probability that a pixel shows the object though its cut lacks it."""
    doubt = torch.where(agreement > _ON_PLANE, 0.0, _DOUBT)
    return torch.where(agreement < _OFF_PLANE, DOUBT_OFF_PLANE, doubt)


def _voted(
    cues: Cues, inside: Maps, voting: ViewMask | None = None, disagreeing: float = _DISAGREEING
) -> Maps | None:
    """Build the hull above the plane, of what is pointed at, and see it in every view.

    Args:
        voting: Views that do; all by default.
    """
    cameras = cues.pictures.cameras
    if voting is None:
        voting = torch.ones(len(inside), dtype=torch.bool)
    silhouettes = Silhouettes(inside=inside, reliable=voting, source="found")
    hull = visual_hull(
        silhouettes, cameras, cues.box_world, num_voxels=NUM_VOXELS, disagreeing=disagreeing
    )
    if hull is None:
        return None
    if cues.plane is not None:
        hull = hull.above(cues.plane.normal_world, cues.plane.offset)
    if cues.soft is not None:
        hull = keep_seeded_components(hull, cameras, cues.soft.seeds_px)
    height, width = inside.shape[1:]

    def margin(view: int) -> Map:
        frame = cameras.cam_from_world[view]
        return margins(hull, cameras.intrinsics[view], frame, (width, height))

    return of_views(margin, len(inside))


def labels_from_points(
    object_px: Pixels,
    background_px: Float[Tensor, "other 2"],
    agreement: Map | None,
    size_px: tuple[int, int],
) -> Labels:
    """Seed with the points that a view observes, the object's and others, and with parallax.

    Without parallax a strip along the border is background.
    """
    longer = max(size_px)
    region = convex_hull_of(object_px, size_px)
    labels = torch.full(size_px[::-1], PERHAPS_BACKGROUND, dtype=torch.uint8)
    if agreement is not None:
        labels[surely_on_plane(agreement)] = BACKGROUND
        region &= ~_shows_plane(agreement)
    else:
        strip = max(1, round(1 / 64 * longer))
        border = torch.ones_like(labels, dtype=torch.bool)
        border[strip:-strip, strip:-strip] = False
        labels[border] = BACKGROUND
    labels[region & (labels != BACKGROUND)] = PERHAPS_OBJECT
    labels[discs_at(background_px, _DISC * longer, size_px)] = BACKGROUND
    labels[discs_at(object_px, _DISC * longer, size_px)] = OBJECT
    return labels


def labels_from_hull(
    margin: Map, cut: Mask, object_px: Pixels, agreement: Map | None, unknown: Mask | None = None
) -> Labels:
    """Seed with a view's last cut, the projection of the hull, points in it, and parallax.

    Nothing is certain where the vote on the hull was ``unknown``, none by default.
    """
    height, width = margin.shape
    longer = max(height, width)
    labels = torch.full(margin.shape, PERHAPS_BACKGROUND, dtype=torch.uint8)
    region = cut | closed(margin > 0, max(1, round(_CLOSING * longer)))
    if agreement is not None:
        region &= ~_shows_plane(agreement)
    labels[region] = PERHAPS_OBJECT
    if agreement is not None:
        labels[surely_on_plane(agreement)] = BACKGROUND
        labels[_grainless(agreement < _OFF_PLANE) & is_inmost(margin)] = OBJECT
    beyond = margin < -1 / 25 * longer
    labels[beyond if unknown is None else beyond & ~unknown] = BACKGROUND
    discs = discs_at(object_px, _DISC * longer, (width, height))
    labels[discs & (margin > 0)] = OBJECT
    return labels


def labels_from_soft(labels: Labels, mask: Mask, margin: Map) -> Labels:
    """Seed with a soft mask where the hull agrees: colours cut near their borders alone."""
    border, reach = signed_distance(mask), 1 / 160 * max(mask.shape)
    labels = torch.where((border > reach) & (margin > 0), OBJECT, labels)
    outside = (border < -reach) & ~is_deep(margin) | (margin < -2 * reach)
    return torch.where(outside, BACKGROUND, labels)


def off_plane_mask(agreement: Map) -> Mask:
    """Find what does not show the plane, or where it is always hidden; unknown counts as plane."""
    found = _grainless(agreement < _NOT_PLANE)
    return filled(closed(found, round(1 / 50 * max(agreement.shape))), agreement)


def occluder_mask(cut: Mask, agreement: Map) -> Mask:
    """Find what is in front of the plane but not the object, such as a person, who may hide it.

    Windows that hold some of the object do not agree with the plane either: what is as narrow as
    these is left out.
    """
    longer = max(cut.shape)
    other = closed(agreement < _OFF_PLANE, round(1 / 200 * longer)) & ~cut
    return opened(other, round(_DEEP * longer))


def is_deep(margin: Map) -> Mask:
    """Find pixels so far inside that shadows next to the object do not reach them."""
    return margin > _DEEP * max(margin.shape)


def is_inmost(margin: Map) -> Mask:
    """Find what is deep inside, and the middle of what is too thin to be deep."""
    longer = max(margin.shape)
    middle = margin > _MIDDLE * dilated(margin, max(1, round(_DEEP * longer)))
    return is_deep(margin) | (middle & (margin > _THIN * longer))


def not_seen_through(object_px: Pixels, agreement: Map) -> Mask:
    """Find what the object's points surround, where the plane is not seen."""
    height, width = agreement.shape
    return convex_hull_of(object_px, (width, height)) & ~_shows_plane(agreement)


def filled(cut: Mask, agreement: Map) -> Mask:
    """Fill holes that the plane is not seen through, such as the inside of a vessel."""
    whole = closed(cut, max(1, round(_CLOSING * max(cut.shape))))
    return cut | blind_holes(whole, agreement > _ON_PLANE, _THROUGH)


def exposed_fraction(cut: Mask, agreement: Map | None) -> Scalar:
    """Return the fraction of a cut that shows a background for certain; 0 where none is known."""
    if agreement is None:
        return torch.zeros((), dtype=torch.float64)
    return (cut & surely_on_plane(agreement)).sum().double() / cut.sum().clamp_min(1)


def held_fraction(cut: Mask, object_px: Pixels) -> Scalar:
    """Return the fraction of the object's points that a cut holds; 1 where too few are known."""
    if len(object_px) < MIN_POINTS:
        return torch.ones((), dtype=torch.float64)
    column, row = object_px.floor().long().unbind(dim=1)
    height, width = cut.shape
    return cut[row.clamp(0, height - 1), column.clamp(0, width - 1)].double().mean()


def surely_on_plane(agreement: Map) -> Mask:
    """Find the plane, but not what is next to something else: the object's foot agrees, too."""
    sure = _grainless(agreement > _ON_PLANE)
    return signed_distance(sure) > 1 / 200 * max(agreement.shape)


def _shows_plane(agreement: Map) -> Mask:
    """Find what some window that agrees with the plane holds."""
    return signed_distance(_grainless(agreement > _ON_PLANE)) > -1 / 160 * max(agreement.shape)


def _grainless(mask: Mask) -> Mask:
    return opened(mask, max(1, round(1 / 200 * max(mask.shape))))
