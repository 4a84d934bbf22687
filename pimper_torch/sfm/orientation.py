"""Which way round the photographs stand that a model was made of, by what its points look like.

COLMAP works on the pixels of files, which EXIF may say are to be turned; photographs are turned
when they are read. Sizes tell a quarter turn, but not which, and not a half. Points tell: what is
round a point in one photograph is round it in the others that observe it, if each is taken the way
the model has it. Squares round a point are compared with those of the other views, turned in all
ways that the sizes allow.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.errors import InputError, caution, some
from pimper_torch.mapped import drop_pages
from pimper_torch.records import Views
from pimper_torch.sfm.crops import resize_fits
from pimper_torch.sfm.model import SparseModel, longest_tracks
from pimper_torch.sfm.quarter_turns import QUARTERS, turned_pixels, turned_size, turned_vectors
from pimper_torch.sfm.squares import (
    ERRORS,
    SAMPLES,
    others_of,
    sides_of,
    squares_in,
    standard_errors,
)

# Points of each view that are looked at, those with the longest tracks: a choice.
_POINTS = 40
# Correlation below which nothing agrees, and observations that it takes to warn of it: choices.
_LEAST, _TELLING = 0.05, 200
# Times that every view is tried anew beside the others: a choice.
_SWEEPS = 5


def find_turns(model: SparseModel, views: Views, where: str) -> tuple[int, ...]:
    """Find by how many clockwise quarters each of a model's pictures is turned in the photographs.

    Tried are the pixels as they are and as their file has them; then each view by itself, where
    its neighbourhoods agree much better another way round.

    Args:
        model: Its views are the photographs, in their order, and have their shapes.
        where: The model is, for messages, as a sentence starts.
    """
    allowed, exif = allowed_turns(model, views), _exif_turns(views)
    upright, stored = _hypotheses(exif, allowed)
    squares = _squares(model, views, allowed)
    changed = (upright != stored)[squares.model.observation_view]
    one, other = (squares.agreement(way)[1][changed] for way in (upright, stored))
    errors = standard_errors(other - one)
    turns = _each(squares, stored if errors > ERRORS else upright, allowed)
    _require_sides(squares, model, views, turns, exif)
    sure = torch.equal(upright, stored) or abs(errors) > ERRORS or not torch.equal(turns, upright)
    _tell(model, turns, where, sure=sure)
    _tell_strangers(squares, turns, where)
    return tuple(turns.tolist())


def possible_turns(model: SparseModel, views: Views) -> list[tuple[int, ...]]:
    """List the turns that pictures may have which no points tell of, as :func:`find_turns`."""
    ways = _hypotheses(_exif_turns(views), allowed_turns(model, views))
    return [tuple(one) for one in dict.fromkeys(tuple(way.tolist()) for way in ways)]


def allowed_turns(model: SparseModel, views: Views) -> Bool[Tensor, "view 4"]:
    """Find the turns by which a resize leads from the model's pictures to the photographs."""
    sizes = [(width, height) for width, height in views.sizes_px.tolist()]
    return torch.tensor(
        [
            [
                resize_fits((lens.width, lens.height), *turned_size(*size, quarters))
                for quarters in range(4)
            ]
            for lens, size in zip(model.lenses, sizes, strict=True)
        ]
    ).reshape(-1, 4)


def _exif_turns(views: Views) -> Int[Tensor, " view"]:
    """Return clockwise quarters that EXIF turned each photograph by; -1 where it mirrored it."""
    tags = [1] * views.num_views if views.orientations is None else views.orientations.tolist()
    return torch.tensor([QUARTERS.get(tag, -1) for tag in tags])


def _hypotheses(
    exif: Int[Tensor, " view"], allowed: Bool[Tensor, "view 4"]
) -> tuple[Int[Tensor, " view"], Int[Tensor, " view"]]:
    """Return the turns of a model of the photographs as they are, and as their files store them."""
    first = allowed.long().argmax(dim=1)
    as_stored = (exif >= 0) & allowed[torch.arange(len(exif)), exif]
    stored = torch.where(as_stored, exif, first)
    return torch.where(allowed[:, 0], 0, stored), stored


@dataclass(frozen=True, slots=True)
class Squares:
    """What is round the points in the photographs, each taken in four ways.

    Attributes:
        model: Of the points with the longest tracks.
        patterns: Unit vectors without mean; zero where a turn is impossible or nothing is seen.
    """

    model: SparseModel
    patterns: Float[Tensor, "observation 4 sample"]

    def agreement(
        self, turns: Int[Tensor, " view"]
    ) -> tuple[
        Float[Tensor, "observation 4"], Float[Tensor, " observation"], Float[Tensor, " observation"]
    ]:
        """Correlate each observation with the others of its point, and with those of another.

        Returns:
            Turned each way; as the turns have it; and so, with another point.
        """
        rows = torch.arange(len(self.patterns)), turns[self.model.observation_view]
        own = self.patterns[rows]
        others, strangers = others_of(own, self.model.observation_point)
        each = (self.patterns * others[:, None]).sum(dim=-1)
        return each, each[rows], (own * strangers).sum(dim=-1)

    def of(self, values: Float[Tensor, "observation 4"], view: int) -> Float[Tensor, "mine 4"]:
        """Take a view's values."""
        return values[self.model.observation_view == view]


def _each(
    squares: Squares, turns: Int[Tensor, " view"], allowed: Bool[Tensor, "view 4"]
) -> Int[Tensor, " view"]:
    """Turn single views with which the others agree much better another way round."""
    for _ in range(_SWEEPS):
        found, (scores, *_) = turns.clone(), squares.agreement(turns)
        for view, fits in enumerate(allowed):
            mine = squares.of(scores, view)
            means = mine.mean(dim=0).masked_fill(~fits, -torch.inf).nan_to_num(-torch.inf)
            best = int(means.argmax())
            gain = standard_errors(mine[:, best] - mine[:, turns[view]])
            if means[best] > _LEAST and gain > ERRORS:
                found[view] = best
        if torch.equal(found, turns):
            break
        turns = found
    return turns


def _require_sides(
    squares: Squares,
    model: SparseModel,
    views: Views,
    turns: Int[Tensor, " view"],
    exif: Int[Tensor, " view"],
) -> None:
    """Refuse a quarter turn that nothing tells the side of: neither EXIF nor the points."""
    scores, *_ = squares.agreement(turns)
    for view, turn in enumerate(turns.tolist()):
        mine = squares.of(scores, view)
        told = standard_errors(mine[:, turn] - mine[:, (turn + 2) % 4]) > ERRORS
        if turn % 2 and turn != int(exif[view]) and not told:
            lens, (width, height) = model.lenses[view], views.sizes_px[view].tolist()
            raise InputError(
                f"{model.names[view]} is {width}x{height}, but the COLMAP model's camera for it is "
                f"{lens.width}x{lens.height}, which is another shape, and neither EXIF nor the "
                "model's points tell how it was turned. Give the photographs the model was made "
                "from, resized if you like, but neither cropped nor turned."
            )


def _tell(model: SparseModel, turns: Int[Tensor, " view"], where: str, *, sure: bool) -> None:
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
    if not sure:
        caution(
            f"EXIF turns photographs, and neither sizes nor points tell whether {_within(where)} "
            "was made of them before or after that; it is taken as made after. If the result is "
            "wrong, save the photographs turned, without EXIF's orientation, and make the model "
            "anew.",
            stacklevel=5,
        )


def _within(where: str) -> str:
    return where.replace("The ", "the ", 1)


def _tell_strangers(squares: Squares, turns: Int[Tensor, " view"], where: str) -> None:
    """Warn where what is round the points agrees no better than by chance."""
    _, own, chance = squares.agreement(turns)
    excess = own - chance
    told = excess[excess != 0]
    if len(told) < _TELLING or standard_errors(told) > ERRORS:
        return
    caution(
        f"What the photographs show round the points of {_within(where)} agrees no "
        f"better between views than by chance (correlation {float(told.mean()):.2f} above it, of "
        f"{len(told)} observations). The model may be of other photographs of these names, or of "
        "cropped ones.",
        stacklevel=5,
    )


def _squares(model: SparseModel, views: Views, allowed: Bool[Tensor, "view 4"]) -> Squares:
    """Sample what is round the points that several views see."""
    some = longest_tracks(model, _POINTS)
    sides = sides_of(some, views)
    patterns = torch.zeros(len(some.observation_view), 4, SAMPLES)
    for view, lens in enumerate(some.lenses):
        here = (some.observation_view == view).nonzero()[:, 0]
        width, height = (int(side) for side in views.sizes_px[view])
        picture = views.images[view, :, :height, :width]
        for quarters in allowed[view].nonzero()[:, 0].tolist():
            before = turned_size(width, height, quarters)
            scale = sides.new_tensor([before[0] / lens.width, before[1] / lens.height])
            centers = turned_pixels(some.observation_pixels[here] * scale, *before, quarters)
            across = turned_vectors(sides[here], quarters)
            patterns[here, quarters] = squares_in(picture, centers, across)
        drop_pages()
    return Squares(some, patterns)
