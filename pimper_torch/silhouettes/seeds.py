"""Certain labels before a view is cut: from points, parallax and the hull."""

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from pimper_torch.silhouettes.opencv import (
    BACKGROUND,
    OBJECT,
    PERHAPS_BACKGROUND,
    PERHAPS_OBJECT,
    blind_holes,
    closed,
    convex_hull_of,
    dilated,
    discs_at,
    opened,
    signed_distance,
)

# Lengths are fractions of the pictures' longer side.
_DISC = 1 / 400  # about a point: its feature is larger, but may reach over the silhouette
_STRIP = 1 / 64  # along the border of a photograph, where nothing else is known
_CLOSING = 1 / 90
_BEYOND = 1 / 25  # what is further outside the hull's projection is background
_DEEP = 1 / 50  # parallax this far inside the projection tells object
_THIN = 1 / 200  # and this far in the middle of a part that is nowhere so deep
_MIDDLE = 0.7  # of the depth of such a part: a body's legs and handle are seeded, no shadow is
_GRAIN = 1 / 200  # what is smaller in parallax is noise
_GAPS = 1 / 50  # in what does not show the plane, as beyond its far border
_BAND = 1 / 160  # about the border of a soft mask
_FOOT = 1 / 200  # parallax says nothing of an object's foot that is so high
# Half a window of agreement: next to the object a window that holds some of it agrees no more. On
# rendered scenes of 24 views (armadillo, mug, balls, potatoes) twice as much is no better.
_HALF_WINDOW = 1 / 160

# Points of the object that a view must observe for them to tell anything.
MIN_POINTS = 12

# Agreement with neighbours moved by the plane: below is not the plane, above is.
_OFF_PLANE = 0.4
_NOT_PLANE = 0.6
_ON_PLANE = 0.75
DISPUTED = 0.5  # where views do not agree on what the background looks like
_THROUGH = 0.2  # of a hole: its border agrees with nothing


def labels_from_points(
    object_px: Float[Tensor, "point 2"],
    background_px: Float[Tensor, "other 2"],
    agreement: Float[Tensor, "height width"] | None,
    size_px: tuple[int, int],
) -> UInt8[Tensor, "height width"]:
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
        strip = max(1, round(_STRIP * longer))
        border = torch.ones_like(labels, dtype=torch.bool)
        border[strip:-strip, strip:-strip] = False
        labels[border] = BACKGROUND
    labels[region & (labels != BACKGROUND)] = PERHAPS_OBJECT
    labels[discs_at(background_px, _DISC * longer, size_px)] = BACKGROUND
    labels[discs_at(object_px, _DISC * longer, size_px)] = OBJECT
    return labels


def labels_from_hull(
    margin: Float[Tensor, "height width"],
    cut: Bool[Tensor, "height width"],
    object_px: Float[Tensor, "point 2"],
    agreement: Float[Tensor, "height width"] | None,
    unknown: Bool[Tensor, "height width"] | None = None,
) -> UInt8[Tensor, "height width"]:
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
    beyond = margin < -_BEYOND * longer
    labels[beyond if unknown is None else beyond & ~unknown] = BACKGROUND
    discs = discs_at(object_px, _DISC * longer, (width, height))
    labels[discs & (margin > 0)] = OBJECT
    return labels


def labels_from_soft(
    labels: UInt8[Tensor, "height width"],
    mask: Bool[Tensor, "height width"],
    margin: Float[Tensor, "height width"],
) -> UInt8[Tensor, "height width"]:
    """Seed with a soft mask where the hull agrees: colours cut near their borders alone."""
    border, reach = signed_distance(mask), _BAND * max(mask.shape)
    labels = torch.where((border > reach) & (margin > 0), OBJECT, labels)
    outside = (border < -reach) & ~is_deep(margin) | (margin < -2 * reach)
    return torch.where(outside, BACKGROUND, labels)


def off_plane(agreement: Float[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """Find what does not show the plane, or where it is always hidden; unknown counts as plane."""
    found = _grainless(agreement < _NOT_PLANE)
    return filled(closed(found, round(_GAPS * max(agreement.shape))), agreement)


def in_front(
    cut: Bool[Tensor, "height width"], agreement: Float[Tensor, "height width"]
) -> Bool[Tensor, "height width"]:
    """Find what stands before the plane and is not the object, as a person who may hide some of it.

    Windows that hold some of the object do not agree with the plane either: what is as narrow as
    these is left out.
    """
    longer = max(cut.shape)
    other = closed(agreement < _OFF_PLANE, round(_GRAIN * longer)) & ~cut
    return opened(other, round(_DEEP * longer))


def is_deep(margin: Float[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """Find what is so far inside that shadows beside the object do not reach it."""
    return margin > _DEEP * max(margin.shape)


def is_inmost(margin: Float[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """Find what is deep inside, and the middle of what is too thin to be deep."""
    longer = max(margin.shape)
    middle = margin > _MIDDLE * dilated(margin, max(1, round(_DEEP * longer)))
    return is_deep(margin) | (middle & (margin > _THIN * longer))


def not_seen_through(
    object_px: Float[Tensor, "point 2"], agreement: Float[Tensor, "height width"]
) -> Bool[Tensor, "height width"]:
    """Find what the object's points surround, where the plane is not seen."""
    height, width = agreement.shape
    return convex_hull_of(object_px, (width, height)) & ~_shows_plane(agreement)


def off_level(agreement: Float[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """Find what is so bright or dark that light cannot make it so on the plane."""
    return _grainless(agreement == -1)


def filled(
    cut: Bool[Tensor, "height width"], agreement: Float[Tensor, "height width"]
) -> Bool[Tensor, "height width"]:
    """Fill holes that the plane is not seen through, such as the inside of a vessel."""
    whole = closed(cut, max(1, round(_CLOSING * max(cut.shape))))
    return cut | blind_holes(whole, agreement > _ON_PLANE, _THROUGH)


def exposed_fraction(
    cut: Bool[Tensor, "height width"], agreement: Float[Tensor, "height width"] | None
) -> Float[Tensor, ""]:
    """Return the fraction of a cut that shows a background for certain; 0 where none is known."""
    if agreement is None:
        return torch.zeros((), dtype=torch.float64)
    return (cut & surely_on_plane(agreement)).sum().double() / cut.sum().clamp_min(1)


def held_fraction(
    cut: Bool[Tensor, "height width"], object_px: Float[Tensor, "point 2"]
) -> Float[Tensor, ""]:
    """Return the fraction of the object's points that a cut holds; 1 where too few are known."""
    if len(object_px) < MIN_POINTS:
        return torch.ones((), dtype=torch.float64)
    column, row = object_px.floor().long().unbind(dim=1)
    height, width = cut.shape
    return cut[row.clamp(0, height - 1), column.clamp(0, width - 1)].double().mean()


def surely_on_plane(agreement: Float[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """Find the plane, but not what is next to something else: the object's foot agrees, too."""
    sure = _grainless(agreement > _ON_PLANE)
    return signed_distance(sure) > _FOOT * max(agreement.shape)


def _shows_plane(agreement: Float[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """Find what some window that agrees with the plane holds."""
    return signed_distance(_grainless(agreement > _ON_PLANE)) > -_HALF_WINDOW * max(agreement.shape)


def _grainless(mask: Bool[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    return opened(mask, max(1, round(_GRAIN * max(mask.shape))))
