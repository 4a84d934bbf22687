"""Alternate graph cuts of every view with a vote of all views on their visual hull.

Cuts are seeded with certain labels: from points, from parallax and, after a vote, from the hull.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from pimper_torch.geometry.opencv import (
    BACKGROUND,
    OBJECT,
    PERHAPS_BACKGROUND,
    PERHAPS_OBJECT,
    blind_holes,
    closing,
    components_of,
    convex_hull_of,
    dilation,
    discs_at,
    grab_cut,
    grab_cut_halved,
    opening,
    signed_distance,
    without_specks,
)
from pimper_torch.geometry.visual_hull import margins, visual_hull
from pimper_torch.records import Record, Silhouettes
from pimper_torch.records.shapes import Map, Maps, Mask, Masks, PerView, Pixels, Scalar, ViewMask
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.mapped import by_view
from pimper_torch.stages.silhouettes.cues import FEW, MIN_POINTS, Cues, keep_seeded_components
from pimper_torch.stages.silhouettes.parallax import DISPUTED, of_views

# Chosen on the four rendered scenes and the skull (benchmarks/studies/silhouettes.py).
_ITERATIONS = 2  # of cutting and voting after the first cut
NUM_VOXELS = 500_000  # of the hull
SPECK = 2e-4  # of the pixels: smaller parts and holes are noise
_DISAGREEING = 0.05  # fraction of the views that may exclude a voxel of the hull

# Larger fractions of disagreeing views, tried in turn until the common hull covers _COMMON of the
# median mask. A mask that contains less than _HELD of the hull's projection shows something else.
_MORE_DISAGREEING, _COMMON, _HELD = (0.15, 0.3, 0.45), 0.2, 0.5

# Lengths are fractions of the images' longer side.
_DISC = 1 / 400  # around a point: its feature is larger, but may cross the silhouette
_CLOSING = 1 / 90
_DEEP = 1 / 50  # parallax this far inside the hull's projection marks the object
_THIN = 1 / 200  # or this far, in the middle of a part that is nowhere so deep
_MIDDLE = 0.7  # of the depth of such a part: seeds legs and handles, but no shadow

# Agreement with the plane: below the first two a pixel does not show it, above the third it does.
_OFF_PLANE = 0.4
_NOT_PLANE = 0.6
_ON_PLANE = 0.75
_THROUGH = 0.2  # fraction of a hole that shows the plane: its border agrees with nothing

# A region outside the hull is a shadow if its log radiance is this far below the cut's median (a
# factor of two). Of such regions of armadillo, ogre and spot under a hard lamp, 150 of 161 shadows
# are darker, and 17 of 90 regions of the object.
_SHADOW = 0.7

# Probability that a pixel outside its cut shows the object, if it contradicts the plane and if it
# merely does not agree. Under a hard lamp (spot and ogre, 30 views all around), 67 and 61 % of the
# missed object pixels contradict the plane, 15 and 20 % of the others; 2 and 1, 48 and 46 % agree.
MISS_OFF_PLANE, _MISS = 0.375, 0.25

Cutter = Callable[[Tensor, Tensor, int], Tensor]  # grab_cut or grab_cut_halved
Labels = UInt8[Tensor, "height width"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Cuts(Record):
    """The object in every view: by the view's own cut, and by the hull of all views.

    Attributes:
        margins_px: Distance inside the hull's projection, in pixels of the working size.
        exposed: Fraction of each cut that certainly shows a background.
        held: Fraction of the object's points that each cut contains.
        rejected: Views whose soft mask was not used.
        agreement: With the backgrounds; ``None`` without any.
        hidden: Pixels of the cuts that show something in front of the object, or ``None``.
        expected: Overlap with the truth that a network expects of each cut, or ``None``.
    """

    masks: Masks
    margins_px: Maps
    exposed: PerView
    held: PerView
    rejected: ViewMask
    agreement: Maps | None
    hidden: Masks | None = None
    expected: PerView | None = None


def cut_in_iterations(cues: Cues) -> Cuts | None:
    """Cut every view, vote on the hull, and cut again from the hull.

    Before every vote the plane's texture is learned anew where cuts do not hide it: holes through
    which it is visible stay open, and occluders stand out. After an initial cut by parallax alone,
    views abstain from the first vote beyond the plane.

    Returns:
        ``None`` if there are no cues, or the cuts have nothing in common.
    """
    if cues.agreement is None and not cues.has_points and cues.soft is None:
        return None
    masks, unknown = _initial_cuts(cues), torch.zeros_like(cues.pictures.grey, dtype=torch.bool)
    if cues.agreement is not None and not cues.has_points:
        unknown = by_view(Tensor.isnan, cues.agreement)  # such as beyond the plane
    rejected = _rejected(cues, masks)
    cues, voting = cues.without(rejected)
    for _ in range(_ITERATIONS):
        cues, masks, hidden = _compare(cues, masks)
        inside = by_view(lambda x, a, b: x.float().masked_fill_(a | b, 0.5), masks, unknown, hidden)
        margins_px = hull_margins(cues, inside, voting)
        if margins_px is None:
            return None
        cues, voting = cues.inside_hull(margins_px), None
        masks, unknown = _cut_again(cues, masks, margins_px, unknown), torch.zeros_like(unknown)
    cues, masks, hidden = _compare(cues, masks)
    inside = by_view(Tensor.float, masks)  # probability of the object
    if cues.agreement is not None:
        inside = by_view(
            lambda mask, plane: torch.where(mask, 1, miss_probability(plane)), masks, cues.agreement
        )
    margins_px = hull_margins(cues, inside.masked_fill_(hidden, 0.5))
    if margins_px is None:
        return None
    masks = repaired(masks, margins_px, None if cues.plane is None else cues.pictures.grey)
    hidden = by_view(lambda occluded, margin: occluded & (margin > 0), hidden, margins_px)
    masks = by_view(torch.bitwise_or, masks, hidden)
    cuts = cuts_of(cues.inside_hull(margins_px), masks, margins_px, rejected)
    return cuts.replace(hidden=hidden) if bool(hidden.any()) else cuts


def cuts_of(cues: Cues, masks: Masks, margins_px: Maps, rejected: ViewMask) -> Cuts:
    """Return the cuts with their agreement with backgrounds and points."""
    count = len(masks)
    return Cuts(
        masks=masks,
        margins_px=margins_px,
        exposed=of_views(lambda i: exposed_fraction(masks[i], cues.agreement_in(i)), count),
        held=of_views(lambda i: held_fraction(masks[i], cues.object_px[i]), count),
        rejected=rejected,
        agreement=cues.agreement,
    )


def repaired(masks: Masks, margins_px: Maps, grey: Maps | None) -> Masks:
    """Return the cuts with shadows removed, or without a plane, with highlights filled in.

    With a supporting plane, shadows are dark pixels outside the hull; holes are known from the
    plane's visibility (:func:`filled`). Without a plane, the hull indicates holes.

    Args:
        grey: Logarithm of the mean radiance; ``None`` without a plane.
    """
    if grey is None:
        # Next to a skull's cheek bone, views see through regions that are half as deep.
        return by_view(
            lambda mask, margin: mask | blind_holes(mask, ~is_deep(margin / 2.0), 0.2),
            masks,
            margins_px,
        )
    repaired_masks = by_view(_without_shadow, masks, margins_px, grey)
    leave_out("silhouettes.shadows", masks & ~repaired_masks)
    return repaired_masks


def _without_shadow(mask: Mask, margin: Map, grey: Map) -> Mask:
    """Remove dark regions outside the hull from a cut: shadows on the plane.

    Shadows move with the light, so other views see the plane there. Regions as bright as the object
    stay: the hull may have lost them, or the camera may be misplaced. If the object itself is
    darker than half of its surroundings, only brighter pixels stay.
    """
    values, far = grey[mask & (margin > 0)], 1 / 200 * max(mask.shape)
    if len(values) == 0:
        return mask
    dark, around = values.median() - _SHADOW, grey[~mask].median() - _SHADOW
    if values.median() < around:
        dark = around
    shadow = mask & (margin < -far / 2) & (grey < dark)
    return mask & ~components_of(shadow, margin < -far)


def _compare(cues: Cues, masks: Masks) -> tuple[Cues, Masks, Masks]:
    """Learn the backgrounds' texture anew where cuts do not hide it, and compare the cuts with it.

    Returns:
        The cues, the cuts with their holes filled, and the pixels where an occluder may hide the
        object, so that the view must abstain.
    """
    cues = cues.relearned(masks)
    agreement = cues.agreement
    if agreement is None:
        return cues, masks, torch.zeros_like(masks)
    filled_masks = of_views(lambda view: filled(masks[view], agreement[view]), len(masks))
    hidden = of_views(lambda view: occluder_mask(filled_masks[view], agreement[view]), len(masks))
    return cues, filled_masks, hidden


def _initial_cuts(cues: Cues) -> Masks:
    """Return initial cuts from points and parallax.

    Parallax alone is used with a plane in front of a static background, or with too few points.
    Cuts have half resolution, as all are cut again. Soft masks only lose the pixels of the plane.
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


def _cut_again(cues: Cues, masks: Masks, margins_px: Maps, unknown: Masks) -> Masks:
    """Cut from the last cut and the hull; drop components that do not meet the hull."""

    def again(view: int) -> Mask:
        points = cues.object_px[view], cues.agreement_in(view)
        labels = labels_from_hull(margins_px[view], masks[view], *points, unknown[view])
        if cues.soft is not None and cues.soft.given[view]:
            labels = labels_from_soft(labels, cues.soft.masks[view], margins_px[view])
        cut = _cut(grab_cut, cues, view, labels, margins_px[view])
        return without_specks(cut, margins_px[view] > 0, round(SPECK * cut.numel()))

    return of_views(again, cues.num_views)


def _cut(how: Cutter, cues: Cues, view: int, labels: Labels, margin: Map) -> Mask:
    """Cut a view by brightness and colour ratios, which shadows change little.

    Colours do not distinguish the grey inside of a vessel from a grey table: with a background,
    pixels well inside are the object's unless the plane is visible there.
    """
    if cues.agreement is None:
        return how(cues.pictures.opponent[view], labels, 2)
    agreement = cues.agreement[view]
    surrounded = not_seen_through(cues.object_px[view], agreement)
    surrounded &= ~(agreement >= DISPUTED)
    labels = torch.where(is_deep(margin / 2.0) & surrounded, OBJECT, labels)
    return how(cues.pictures.opponent[view], labels, 2)


def _rejected(cues: Cues, masks: Masks) -> ViewMask:
    """Return the views whose soft mask lacks most of the common hull; all if that is small."""
    if cues.soft is None or int(cues.soft.given.sum()) < FEW:
        return torch.zeros(len(masks), dtype=torch.bool)
    given = cues.soft.given
    for disagreeing in (_DISAGREEING, *_MORE_DISAGREEING):
        margins_px = hull_margins(cues, masks.float(), given, disagreeing)
        if margins_px is not None:
            common = margins_px > 0
            common_area, area = (part.sum(dim=(1, 2)).clamp_min(1) for part in (common, masks))
            if (common_area / area)[given].median() >= _COMMON:
                return given & ((masks & common).sum(dim=(1, 2)) < _HELD * common_area)
    return given


def miss_probability(agreement: Map) -> Map:
    """Return the probability that a pixel outside its cut shows the object."""
    probability = torch.where(agreement > _ON_PLANE, 0.0, _MISS)
    return torch.where(agreement < _OFF_PLANE, MISS_OFF_PLANE, probability)


def hull_margins(
    cues: Cues, inside: Maps, voting: ViewMask | None = None, disagreeing: float = _DISAGREEING
) -> Maps | None:
    """Build the hull of seeded components above the plane; return its margins in every view.

    Args:
        voting: Views that vote; all by default.
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
        pose = cameras.cam_from_world[view]
        return margins(hull, cameras.intrinsics[view], pose, (width, height))

    return of_views(margin, len(inside))


def labels_from_points(
    object_px: Pixels,
    background_px: Float[Tensor, "other 2"],
    agreement: Map | None,
    size_px: tuple[int, int],
) -> Labels:
    """Return seeds from the observed points of the object and of the background, and from parallax.

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
    """Return seeds from a view's last cut, the hull's projection, points inside it, and parallax.

    The hull does not exclude pixels whose vote was ``unknown``, none by default.
    """
    height, width = margin.shape
    longer = max(height, width)
    labels = torch.full(margin.shape, PERHAPS_BACKGROUND, dtype=torch.uint8)
    region = cut | closing(margin > 0, max(1, round(_CLOSING * longer)))
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
    """Seed with a soft mask where the hull agrees: colours decide only near the borders."""
    border, reach = signed_distance(mask), 1 / 160 * max(mask.shape)
    labels = torch.where((border > reach) & (margin > 0), OBJECT, labels)
    outside = (border < -reach) & ~is_deep(margin) | (margin < -2 * reach)
    return torch.where(outside, BACKGROUND, labels)


def off_plane_mask(agreement: Map) -> Mask:
    """Return the pixels that do not show the plane; unknown ones count as plane."""
    off_plane = _grainless(agreement < _NOT_PLANE)
    return filled(closing(off_plane, round(1 / 50 * max(agreement.shape))), agreement)


def occluder_mask(cut: Mask, agreement: Map) -> Mask:
    """Return the pixels of occluders, such as a person: in front of the plane, but not the object.

    Windows that overlap the object do not agree with the plane either, so regions as narrow as
    such windows are excluded.
    """
    longer = max(cut.shape)
    other = closing(agreement < _OFF_PLANE, round(1 / 200 * longer)) & ~cut
    return opening(other, round(_DEEP * longer))


def is_deep(margin: Map) -> Mask:
    """Return the pixels so far inside that shadows next to the object do not reach them."""
    return margin > _DEEP * max(margin.shape)


def is_inmost(margin: Map) -> Mask:
    """Return the pixels deep inside, and the middle of parts too thin to be deep."""
    longer = max(margin.shape)
    middle = margin > _MIDDLE * dilation(margin, max(1, round(_DEEP * longer)))
    return is_deep(margin) | (middle & (margin > _THIN * longer))


def not_seen_through(object_px: Pixels, agreement: Map) -> Mask:
    """Return the pixels between the object's points that do not show the plane."""
    height, width = agreement.shape
    return convex_hull_of(object_px, (width, height)) & ~_shows_plane(agreement)


def filled(cut: Mask, agreement: Map) -> Mask:
    """Fill holes through which the plane is not visible, such as the inside of a vessel."""
    filled_cut = closing(cut, max(1, round(_CLOSING * max(cut.shape))))
    return cut | blind_holes(filled_cut, agreement > _ON_PLANE, _THROUGH)


def exposed_fraction(cut: Mask, agreement: Map | None) -> Scalar:
    """Return the fraction of a cut that certainly shows a background; 0 without a background."""
    if agreement is None:
        return torch.zeros((), dtype=torch.float64)
    return (cut & surely_on_plane(agreement)).sum().double() / cut.sum().clamp_min(1)


def held_fraction(cut: Mask, object_px: Pixels) -> Scalar:
    """Return the fraction of the object's points that a cut contains; 1 with too few points."""
    if len(object_px) < MIN_POINTS:
        return torch.ones((), dtype=torch.float64)
    column, row = object_px.floor().long().unbind(dim=1)
    height, width = cut.shape
    return cut[row.clamp(0, height - 1), column.clamp(0, width - 1)].double().mean()


def surely_on_plane(agreement: Map) -> Mask:
    """Return the plane's pixels, except near others: the object's foot agrees, too."""
    sure = _grainless(agreement > _ON_PLANE)
    return signed_distance(sure) > 1 / 200 * max(agreement.shape)


def _shows_plane(agreement: Map) -> Mask:
    """Return the pixels inside some window that agrees with the plane."""
    return signed_distance(_grainless(agreement > _ON_PLANE)) > -1 / 160 * max(agreement.shape)


def _grainless(mask: Mask) -> Mask:
    return opening(mask, max(1, round(1 / 200 * max(mask.shape))))
