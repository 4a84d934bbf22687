"""Photographs as resized, turned or cropped versions of the pictures that cameras are of.

COLMAP works on the pixels of files, which EXIF may say are to be turned; photographs are turned
when they are read. Sizes tell a quarter turn, but not which, and not a half; nor do they tell a
crop from a resize, nor camera raw, whose margins JPEG leaves out. Points tell: what is round a
point in one photograph is round it in the others that observe it, if each is taken the way the
model has it, and less so beside it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.errors import InputError, caution, some
from pimper_torch.records import Views
from pimper_torch.sfm.colmap import pinhole_of
from pimper_torch.sfm.conventions.choice import ERRORS, standard_errors, surely_better
from pimper_torch.sfm.conventions.correlation import others_of, sampled
from pimper_torch.sfm.model import SparseModel, longest_tracks
from pimper_torch.sfm.quarter_turns import (
    QUARTERS,
    cropped_lens,
    turned_pixels,
    turned_size,
    turned_vectors,
)

Size = tuple[int, int]
Turns = Int[Tensor, " view"]

# Points of each view that are looked at for turns, those with the longest tracks: a choice.
_POINTS = 40
# Correlation below which nothing agrees, and observations that it takes to warn of it: choices.
_LEAST, _TELLING = 0.05, 200
# Times that every view is tried anew beside the others: a choice.
_SWEEPS = 5
# Points of each view that must agree less where photographs are shifted by so much. Of photographs
# of potatoes, mug, jar and balls (8 and 12 views of 240x180 and 320x240) that were cropped to 0.95
# to 0.5 of their size, of the shifts about a resize one at least is worse by 1.5 standard errors at
# most; about the truth all are by 4.9 and more.
_POINTS_BESIDE, REACHES = 400, (4.0, 8.0)


class Ways(NamedTuple):
    """Models that differ in how the photographs may have come from the pictures that they are of.

    Attributes:
        plain: Resized; in the pixels of photographs as they stand, then as files store them, where
            no points tell. Empty where no resize leads to a photograph's shape.
        cropped: Cut out in the usual ways, where sizes differ and no points tell of a resize.
        changed: Numbers of the photographs of another size.
    """

    plain: Sequence[SparseModel]
    cropped: Sequence[SparseModel] = ()
    changed: Sequence[int] = ()


def resize_fits(whole: Size, width: int, height: int) -> bool:
    """Return whether a resize alone leads from a picture of one size to one of another."""
    # Rounding a side to whole pixels changes the shape by less than this.
    ratio = width / whole[0] / (height / whole[1])
    return abs(ratio - 1) <= max(0.01, 2 / min(width, height))


def allowed_turns(model: SparseModel, views: Views) -> Bool[Tensor, "view 4"]:
    """Find the turns by which a resize leads from the model's pictures to the photographs."""
    fits = [
        [
            resize_fits((lens.width, lens.height), *turned_size(width, height, quarters))
            for quarters in range(4)
        ]
        for lens, (width, height) in zip(model.lenses, views.sizes_px.tolist(), strict=True)
    ]
    return torch.tensor(fits).reshape(-1, 4)


def possible_turns(model: SparseModel, views: Views) -> list[tuple[int, ...]]:
    """List the turns that pictures may have which no points tell of, as :func:`find_turns`."""
    ways = _upright_and_stored(_exif_turns(views), allowed_turns(model, views))
    return list(dict.fromkeys(tuple(way.tolist()) for way in ways))


def find_turns(model: SparseModel, views: Views, where: str) -> tuple[int, ...]:
    """Find by how many clockwise quarters each of a model's pictures is turned in the photographs.

    Tried are the pixels as they are and as their file has them; then each view by itself, where
    its neighbourhoods agree much better another way round.

    Args:
        model: Its views are the photographs, in their order, and have their shapes.
        where: The model is, for messages, as a sentence starts.
    """
    allowed, exif = allowed_turns(model, views), _exif_turns(views)
    upright, stored = _upright_and_stored(exif, allowed)
    chosen, squares = _turned_squares(model, views, allowed)
    changed = (upright != stored)[chosen.observation_view]
    one, other = (_agreement(squares, chosen, way)[1][changed] for way in (upright, stored))
    errors = standard_errors(other - one)
    turns = _each(squares, chosen, stored if errors > ERRORS else upright, allowed)
    each, own, chance = _agreement(squares, chosen, turns)
    _require_sides(each, chosen, views, turns, exif)
    _tell_turns(model, turns, where)
    if torch.equal(turns, upright) and not torch.equal(upright, stored) and abs(errors) <= ERRORS:
        tell_open_turns(where, "points")
    excess = (own - chance)[own != chance]
    if len(excess) >= _TELLING and standard_errors(excess) <= ERRORS:
        caution(
            f"What the photographs show round the points of {_within(where)} agrees no better "
            f"between views than by chance (correlation {float(excess.mean()):.2f} above it, of "
            f"{len(excess)} observations). The model may be of other photographs of these names, "
            "or of cropped ones.",
            stacklevel=4,
        )
    return tuple(turns.tolist())


def tell_open_turns(where: str, what: str) -> None:
    """Warn that neither sizes nor something else tells how pictures are turned."""
    caution(
        f"EXIF turns photographs, and neither sizes nor {what} tell whether {_within(where)} was "
        "made of them before or after that; it is taken as made after. If the result is wrong, "
        "save the photographs turned, without EXIF's orientation.",
        stacklevel=5,
    )


def points_tell(
    model: SparseModel, views: Views, changed: Sequence[int], reaches_px: Sequence[float] = REACHES
) -> float:
    """Return how well photographs agree round the points; 0 where they agree as well beside them.

    Args:
        model: In the pixels of the photographs.
        changed: Numbers of those whose place is in question.
        reaches_px: How far they are shifted for comparison, one distance after the other.
    """
    if not len(model.points_world):
        return 0.0
    chosen = longest_tracks(model, _POINTS_BESIDE)
    mine = torch.isin(chosen.observation_view, torch.tensor(changed))
    for reach_px in reaches_px:
        shifts = reach_px * torch.cat([torch.zeros(1, 2), around(chosen.points_world)])

        def places(
            view: int, pixels: Tensor, sides: Tensor, steps: Tensor = shifts
        ) -> tuple[Tensor, Tensor]:
            return pixels + (view in changed) * steps[:, None], sides[None]

        squares = sampled(chosen, views, places, len(shifts))
        own = (squares * others_of(squares, chosen.observation_point)[0]).sum(dim=-1)
        own = own[:, mine & (own[0] != 0)]
        if all(surely_better(own[0], one) for one in own[1:]):
            return float(own[0].mean())
    return 0.0


def changed_views(model: SparseModel, sizes_px: Sequence[Size]) -> list[int]:
    """Return the numbers of the photographs whose size is not that of the model's picture."""
    sizes = enumerate(zip(sizes_px, model.lenses, strict=True))
    return [view for view, (size, lens) in sizes if size != (lens.width, lens.height)]


def possible_crops(model: SparseModel, sizes_px: Sequence[Size]) -> list[SparseModel]:
    """Cut the pictures of a model in the usual ways; none where no size differs.

    Args:
        model: Its views are the photographs, in their order.
        sizes_px: Their sizes before they were shrunk on reading, as the pictures lie.

    Returns:
        Photographs from the middle, then from the borders and corners.
    """
    changed, fresh = changed_views(model, sizes_px), max(lens.camera for lens in model.lenses)
    ways = []
    for place in torch.tensor([0.5, 0.0, 1.0])[torch.cartesian_prod(*[torch.arange(3)] * 2)]:
        way = model
        for view in changed:
            lens = model.lenses[view]
            room = torch.tensor([lens.width, lens.height]) - torch.tensor(sizes_px[view])
            way = cut(way, [view], sizes_px[view], place * room.double(), fresh)
        ways.append(way)
    return ways if changed else []


def cut(
    model: SparseModel,
    views: Sequence[int],
    size: Size | None,
    shift: Float[Tensor, "2"],
    fresh: int = 0,
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
        smaller = cropped_lens(lens, *(size or (lens.width, lens.height)), shift)
        lenses[view] = smaller.replace(camera=fresh + lens.camera)
    here = torch.isin(model.observation_view, torch.tensor(views))
    pixels = torch.where(here[:, None], model.observation_pixels - shift, model.observation_pixels)
    return model.replace(lenses=tuple(lenses), observation_pixels=pixels)


def tell_crop(where: str, crop: SparseModel, changed: Sequence[int], evidence: str) -> None:
    """Warn that photographs are cropped ones, and where the principal point is in the first."""
    lens = crop.lenses[changed[0]]
    x, y = pinhole_of(lens)[:2, 2].tolist()
    caution(
        f"{of_another_size(where, crop, changed)}, and {evidence} tells that these are no resized "
        f"ones, but cropped: the principal point is at ({x:.0f}, {y:.0f}) of "
        f"{lens.width}x{lens.height}. Cameras and observations follow. If that is wrong, give the "
        "photographs that it was made from.",
        stacklevel=6,
    )


def of_another_size(where: str, model: SparseModel, changed: Sequence[int]) -> str:
    """State which photographs are of another size, in a part of a sentence."""
    names = some([model.names[view] for view in changed], 4)
    return (
        f"{where} is of pictures of another size than {len(changed)} of {model.num_views} "
        f"photographs ({names})"
    )


def around(like: Tensor) -> Float[Tensor, "8 2"]:
    """List the steps to the neighbours of a pixel."""
    steps = torch.tensor([-1, 0, 1]).to(like)
    ring = torch.cartesian_prod(steps, steps)
    return ring[ring.abs().sum(dim=1) > 0]


def _exif_turns(views: Views) -> Turns:
    """Return clockwise quarters that EXIF turned each photograph by; -1 where it mirrored it."""
    tags = [1] * views.num_views if views.orientations is None else views.orientations.tolist()
    return torch.tensor([QUARTERS.get(tag, -1) for tag in tags])


def _upright_and_stored(exif: Turns, allowed: Bool[Tensor, "view 4"]) -> tuple[Turns, Turns]:
    """Return the turns of a model of the photographs as they are, and as their files store them."""
    first = allowed.long().argmax(dim=1)
    as_stored = (exif >= 0) & allowed[torch.arange(len(exif)), exif]
    stored = torch.where(as_stored, exif, first)
    return torch.where(allowed[:, 0], 0, stored), stored


def _turned_squares(
    model: SparseModel, views: Views, allowed: Bool[Tensor, "view 4"]
) -> tuple[SparseModel, Float[Tensor, "4 observation sample"]]:
    """Sample what is round the points with the longest tracks, turned in all four ways.

    Zero where a turn is impossible.
    """

    def places(view: int, pixels: Tensor, sides: Tensor) -> tuple[Tensor, Tensor]:
        lens, (width, height) = model.lenses[view], views.sizes_px[view].tolist()
        centers = pixels.new_full((4, len(pixels), 2), torch.nan)
        for quarters in allowed[view].nonzero()[:, 0].tolist():
            before = turned_size(width, height, quarters)
            scale = pixels.new_tensor([before[0] / lens.width, before[1] / lens.height])
            centers[quarters] = turned_pixels(pixels * scale, *before, quarters)
        return centers, torch.stack([turned_vectors(sides, quarters) for quarters in range(4)])

    chosen = longest_tracks(model, _POINTS)
    return chosen, sampled(chosen, views, places, 4)


def _agreement(
    squares: Float[Tensor, "4 observation sample"], model: SparseModel, turns: Turns
) -> tuple[
    Float[Tensor, "4 observation"], Float[Tensor, " observation"], Float[Tensor, " observation"]
]:
    """Correlate each observation with the others of its point, and with those of another.

    Returns:
        Turned each way; as the turns have it; and so, with another point.
    """
    rows = turns[model.observation_view], torch.arange(squares.shape[1])
    own = squares[rows]
    others, strangers = others_of(own, model.observation_point)
    each = (squares * others).sum(dim=-1)
    return each, each[rows], (own * strangers).sum(dim=-1)


def _each(
    squares: Float[Tensor, "4 observation sample"],
    model: SparseModel,
    turns: Turns,
    allowed: Bool[Tensor, "view 4"],
) -> Turns:
    """Turn single views with which the others agree much better another way round."""
    for _ in range(_SWEEPS):
        found, (scores, *_) = turns.clone(), _agreement(squares, model, turns)
        for view, fits in enumerate(allowed):
            mine = scores[:, model.observation_view == view]
            means = mine.mean(dim=1).masked_fill(~fits, -torch.inf).nan_to_num(-torch.inf)
            best = int(means.argmax())
            if means[best] > _LEAST and surely_better(mine[best], mine[turns[view]]):
                found[view] = best
        if torch.equal(found, turns):
            break
        turns = found
    return turns


def _require_sides(
    scores: Float[Tensor, "4 observation"],
    model: SparseModel,
    views: Views,
    turns: Turns,
    exif: Turns,
) -> None:
    """Refuse a quarter turn that nothing tells the side of: neither EXIF nor the points."""
    for view, turn in enumerate(turns.tolist()):
        mine = scores[:, model.observation_view == view]
        if turn % 2 and turn != int(exif[view]) and not surely_better(mine[turn], mine[turn - 2]):
            lens, (width, height) = model.lenses[view], views.sizes_px[view].tolist()
            raise InputError(
                f"{model.names[view]} is {width}x{height}, but the COLMAP model's camera for it is "
                f"{lens.width}x{lens.height}, which is another shape, and neither EXIF nor the "
                "model's points tell how it was turned. Give the photographs the model was made "
                "from, resized if you like, but neither cropped nor turned."
            )


def _tell_turns(model: SparseModel, turns: Turns, where: str) -> None:
    """State which way round was taken for how many photographs."""
    parts = []
    for quarters in (1, 2, 3):
        names = [model.names[view] for view in (turns == quarters).nonzero()[:, 0].tolist()]
        if names:
            parts.append(f"{len(names)} by {90 * quarters} degrees clockwise ({some(names, 4)})")
    if parts:
        caution(
            f"{where} was made of pictures that stand otherwise than the photographs, such as the "
            "pixels that files store before EXIF turns them. Its cameras and observations are "
            f"turned for {int((turns > 0).sum())} of {model.num_views} photographs: "
            f"{'; '.join(parts)}.",
            stacklevel=5,
        )


def _within(where: str) -> str:
    return where.replace("The ", "the ", 1)
