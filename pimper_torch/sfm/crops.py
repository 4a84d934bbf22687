"""Photographs that were cropped since cameras were made of them, or that reach beyond the pictures.

Sizes alone do not tell a crop from a resize, nor do they of camera raw, whose margins JPEG leaves
out. Points tell a resize and the usual crops: what is round them agrees between views, and less so
beside them. Else matches tell: with the right principal point they lie nearest to epipolar lines.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.errors import InputError, caution, some
from pimper_torch.records import Views
from pimper_torch.sfm.agreement import match_errors
from pimper_torch.sfm.colmap import pinhole_of
from pimper_torch.sfm.matching import VerifiedPair
from pimper_torch.sfm.model import SparseModel, longest_tracks
from pimper_torch.sfm.photograph_agreement import explained_fraction
from pimper_torch.sfm.quarter_turns import QUARTERS, cropped_lens, turned_size
from pimper_torch.sfm.squares import (
    ERRORS,
    SAMPLES,
    others_of,
    sides_of,
    squares_in,
    standard_errors,
)

# Points of each view that must agree less where photographs are shifted by so much. Of photographs
# of potatoes, mug, jar and balls (8 and 12 views of 240x180 and 320x240) that were cropped to 0.95
# to 0.5 of their size, of the shifts about a resize one at least is worse by 1.5 standard errors at
# most; about the truth all are by 4.9 and more.
_POINTS, REACHES = 400, (4.0, 8.0)
# A crop explains more of the matches than this; photographs that it places beside by so much must
# explain them worse; the last steps of the search, and how many in a row: choices.
_EXPLAINED, _BESIDE_PX, _STEP_PX, _MOST_STEPS = 0.95, 8.0, 0.5, 12
# Pairs that are looked at, those with most matches. A choice: enough, and a second.
_PAIRS = 200

Size = tuple[int, int]


def resize_fits(whole: Size, width: int, height: int) -> bool:
    """Return whether a resize alone leads from a picture of one size to one of another."""
    # Rounding a side to whole pixels changes the shape by less than this.
    ratio = width / whole[0] / (height / whole[1])
    return abs(ratio - 1) <= max(0.01, 2 / min(width, height))


def points_tell(
    model: SparseModel, views: Views, changed: Sequence[int], reaches_px: Sequence[float] = REACHES
) -> float:
    """Return how well photographs agree round the points; 0 where they agree as well beside them.

    Args:
        model: In the pixels of the photographs.
        changed: Numbers of those whose place is in question.
        reaches_px: How far they are shifted for comparison, one distance after the other.
    """
    chosen = longest_tracks(model, _POINTS)
    sides = sides_of(chosen, views)
    mine = torch.isin(chosen.observation_view, torch.tensor(changed))
    for reach_px in reaches_px if len(model.points_world) else ():
        shifts = reach_px * torch.cat([torch.zeros(1, 2), _around(sides)])
        squares = torch.zeros(len(shifts), len(sides), SAMPLES)
        for view, (width, height) in enumerate(views.sizes_px.tolist()):
            here = (chosen.observation_view == view).nonzero()[:, 0]
            centers = chosen.observation_pixels[here] + (view in changed) * shifts[:, None]
            picture = views.images[view, :, :height, :width]
            squares[:, here] = squares_in(picture, centers, sides[here])
        own = (squares * others_of(squares, chosen.observation_point)[0]).sum(dim=-1)
        own = own[:, mine & (own[0] != 0)]
        if min(standard_errors(own[0] - one) for one in own[1:]) > ERRORS:
            return float(own[0].mean())
    return 0.0


def possible_crops(model: SparseModel, views: Views, sizes_px: Sequence[Size]) -> list[SparseModel]:
    """Cut the pictures of a model in the usual ways; none where no size differs.

    Args:
        model: Its views are the photographs, in their order.
        sizes_px: Their sizes before they were shrunk on reading.

    Returns:
        Photographs from the middle, then from the borders and corners.
    """
    tags = [1] * views.num_views if views.orientations is None else views.orientations.tolist()
    sizes = [
        # Turned as EXIF does where the model's pictures lie across them otherwise.
        turned_size(*size, QUARTERS.get(tag, 0) or 1)
        if (size[0] > size[1]) != (lens.width > lens.height)
        else size
        for tag, size, lens in zip(tags, sizes_px, model.lenses, strict=True)
    ]
    if sizes == [(lens.width, lens.height) for lens in model.lenses]:
        return []
    fresh = max(lens.camera for lens in model.lenses)
    ways = []
    for place in torch.tensor([0.5, 0.0, 1.0])[torch.cartesian_prod(*[torch.arange(3)] * 2)]:
        way = model
        for view, (size, lens) in enumerate(zip(sizes, model.lenses, strict=True)):
            room = torch.tensor([lens.width - size[0], lens.height - size[1]]).double()
            if bool(room.any()):
                way = _cut(way, [view], size, place * room, fresh)
        ways.append(way)
    return ways


def find_crop(
    plain: SparseModel | None,
    crops: Sequence[SparseModel],
    verified: Sequence[VerifiedPair],
    max_error_px: float,
    where: str,
) -> SparseModel | None:
    """Find where photographs were cut out of the pictures that cameras are of, by their matches.

    From the best of the usual crops on, all of them are shifted together until matches lie nearest
    to the epipolar lines.

    Args:
        plain: Cameras of resized photographs, if such a shape is possible: the plain explanation.
        crops: Cameras of photographs that were cropped in the usual ways; at least two.
        verified: Matches that an epipolar geometry of their own explains.
        max_error_px: Distance from epipolar lines that is not told from a larger one.
        where: The cameras are, for messages.

    Returns:
        ``None`` where a resize explains the matches as well.

    Raises:
        InputError: A crop explains them better, but none explains them, or several do.
    """
    strongest = sorted(verified, key=lambda pair: -pair.num_matches)[:_PAIRS]

    def errors(model: SparseModel) -> Float[Tensor, " match"]:
        return match_errors(model, strongest).clamp_max(max_error_px)

    usual = min(crops, key=lambda model: float(errors(model).mean()))
    views = changed_views(crops)

    def shifted(shift: Float[Tensor, "2"]) -> SparseModel:
        return _cut(usual, views, None, shift, 0)

    middle, corner = (pinhole_of(model.lenses[views[0]])[:2, 2] for model in (crops[0], crops[-1]))
    room = 2 * (middle - corner).abs()
    shift, step = torch.zeros_like(room), float(room.max()) / 4
    while step >= _STEP_PX:
        for _ in range(_MOST_STEPS):
            ring = torch.cat([torch.zeros(1, 2).to(shift), step * _around(shift)])
            ways = torch.minimum(torch.maximum(shift + ring, -room), room)
            means = torch.stack([errors(shifted(way)).mean() for way in ways])
            nearest = ways[means.argmin()]
            if torch.equal(nearest, shift):
                break
            shift = nearest
        step /= 2
    if standard_errors(errors(usual) - errors(shifted(shift))) <= ERRORS:
        shift = torch.zeros_like(shift)
    best = errors(shifted(shift))
    better = math.inf if plain is None else standard_errors(errors(plain) - best)
    if better <= ERRORS:
        return None
    crop = shifted(shift)
    beside = [errors(shifted(shift + _BESIDE_PX * one)) for one in _around(shift)]
    sharp = min(standard_errors(one - best) for one in beside) > ERRORS
    evidence = "what their matches show"
    if explained_fraction(crop, verified, max_error_px) <= _EXPLAINED or not sharp:
        raise InputError(
            f"{_which(where, usual, crops)}, and {evidence} fits a crop better than a resize, but "
            "does not tell which crop. Give the photographs that it was made from, resized if you "
            "like, but not cropped."
        )
    tell_crop(where, crop, crops, evidence)
    return crop


def tell_crop(where: str, crop: SparseModel, crops: Sequence[SparseModel], evidence: str) -> None:
    """Warn that photographs are cropped ones, and where the principal point is in the first."""
    lens = crop.lenses[changed_views(crops)[0]]
    x, y = pinhole_of(lens)[:2, 2].tolist()
    caution(
        f"{_which(where, crop, crops)}, and {evidence} tells that these are no resized ones, but "
        f"cropped: the principal point is at ({x:.0f}, {y:.0f}) of {lens.width}x{lens.height}. "
        "Cameras and observations follow. If that is wrong, give the photographs that it was made "
        "from.",
        stacklevel=6,
    )


def _which(where: str, model: SparseModel, crops: Sequence[SparseModel]) -> str:
    names = [model.names[view] for view in changed_views(crops)]
    return (
        f"{where} is of pictures of another size than {len(names)} of {model.num_views} "
        f"photographs ({some(names, 4)})"
    )


def changed_views(crops: Sequence[SparseModel]) -> list[int]:
    """Return the numbers of the photographs whose lenses differ between crops."""
    ends = zip(crops[0].lenses, crops[-1].lenses, strict=True)
    return [view for view, (one, other) in enumerate(ends) if one != other]


def _cut(
    model: SparseModel,
    views: Sequence[int],
    size: Size | None,
    shift: Float[Tensor, "2"],
    fresh: int,
) -> SparseModel:
    """Cut the pictures of some views: their lenses and observations follow.

    Args:
        size: Width and height of what is cut out; ``None`` leaves them.
        shift: Its corner, pixels of the pictures.
        fresh: Added to the numbers of their cameras.
    """
    lenses = list(model.lenses)
    for view in views:
        lens = lenses[view]
        cut = cropped_lens(lens, *(size or (lens.width, lens.height)), shift)
        lenses[view] = cut.replace(camera=fresh + lens.camera)
    here = torch.isin(model.observation_view, torch.tensor(views))
    pixels = torch.where(here[:, None], model.observation_pixels - shift, model.observation_pixels)
    return model.replace(lenses=tuple(lenses), observation_pixels=pixels)


def _around(like: Tensor) -> Float[Tensor, "8 2"]:
    """List the steps to the neighbours of a pixel."""
    steps = torch.tensor([-1, 0, 1]).to(like)
    ring = torch.cartesian_prod(steps, steps)
    return ring[ring.abs().sum(dim=1) > 0]
