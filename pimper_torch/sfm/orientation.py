"""Which way round the photographs stand that a model was made of, by what its points look like.

COLMAP works on the pixels of files, which EXIF may say are to be turned; photographs are turned
when they are read. Sizes tell a quarter turn, but not which, and not a half. Points tell: what is
round a point in one photograph is round it in the others that observe it, if each is taken the way
the model has it. Squares round a point, on the plane across its mean viewing direction, are
correlated with the mean of the others, turned in all ways that the sizes allow.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, normalize, one_hot

from pimper_torch.errors import InputError, caution, some
from pimper_torch.geometry.frames import transform
from pimper_torch.geometry.pixels import grid_from_pixels
from pimper_torch.records import Lens, Views
from pimper_torch.sfm import colmap
from pimper_torch.sfm.model import SparseModel, longest_tracks
from pimper_torch.sfm.quarter_turns import QUARTERS, turned_pixels, turned_size, turned_vectors

# Points of each view that are looked at, those with the longest tracks; samples to either side of
# a point, and pixels from one to the next: choices.
_POINTS, _REACH, _STEP_PX = 40, 3, 1.5
# Standard errors by which one way must be better than another, and observations it takes: choices.
_ERRORS, _FEWEST = 4.0, 8
# Correlation below which nothing agrees, and observations that it takes to warn of it: choices.
_LEAST, _TELLING = 0.05, 200
# Times that every view is tried anew beside the others: a choice.
_SWEEPS = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Squares:
    """What is round the points in the photographs, each taken in four ways.

    Attributes:
        point: That each observation sees.
        view: It is made in.
        patterns: Unit vectors without mean; zero where a turn is impossible or nothing is seen.
    """

    point: Int[Tensor, " observation"]
    view: Int[Tensor, " observation"]
    patterns: Float[Tensor, "observation 4 sample"]

    def agreement(self, turns: Int[Tensor, " view"]) -> Float[Tensor, "observation 4"]:
        """Correlate each observation, turned each way, with the mean of the others of its point."""
        own = self._taken(turns)
        others = self._sums(own)[self.point] - own
        return (self.patterns * normalize(others, dim=-1)[:, None]).sum(dim=-1)

    def chance(self, turns: Int[Tensor, " view"]) -> Float[Tensor, " observation"]:
        """Correlate each observation with the mean of another point."""
        own = self._taken(turns)
        sums = normalize(self._sums(own), dim=-1)
        return (own * sums[self.point - 1]).sum(dim=-1)

    def _taken(self, turns: Int[Tensor, " view"]) -> Float[Tensor, "observation sample"]:
        return self.patterns[torch.arange(len(self.view)), turns[self.view]]

    def _sums(self, own: Float[Tensor, "observation sample"]) -> Float[Tensor, "point sample"]:
        count = int(self.point.max()) + 1 if len(self.point) else 0
        return own.new_zeros(count, own.shape[1]).index_add(0, self.point, own)


def find_turns(model: SparseModel, views: Views, where: str) -> tuple[int, ...]:
    """Tell by how many clockwise quarters each of a model's pictures is turned in the photographs.

    Tried are the pixels as they are and as their file has them; then each view by itself, where
    its neighbourhoods agree much better another way round.

    Args:
        model: Its views are the photographs, in their order.
        views: The photographs.
        where: The model is, for messages, as a sentence starts.

    Raises:
        InputError: A photograph has another shape than the model's whichever way it is turned, or
            may be turned either way.
    """
    allowed, exif = _allowed(model, views), _exif_turns(views)
    sizes = [(width, height) for width, height in views.sizes_px.tolist()]
    upright, stored = _hypotheses(exif, allowed)
    squares = _squares(model, views, allowed)
    turns, sure = _better(squares, upright, stored)
    turns = _each(squares, turns, allowed)
    _require_sides(squares, model, sizes, turns, exif)
    _tell(model, views, turns, where, sure=sure or not torch.equal(turns, upright))
    _tell_strangers(squares, turns, where)
    return tuple(turns.tolist())


def possible_turns(model: SparseModel, views: Views) -> list[tuple[int, ...]]:
    """List the turns that the pictures of a model without points may have, as :func:`find_turns`.

    Raises:
        InputError: A photograph has another shape than the model's whichever way it is turned.
    """
    ways = _hypotheses(_exif_turns(views), _allowed(model, views))
    return [tuple(one) for one in dict.fromkeys(tuple(way.tolist()) for way in ways)]


def _allowed(model: SparseModel, views: Views) -> Bool[Tensor, "view 4"]:
    """Mark the turns that the shapes of pictures allow."""
    sizes = [(width, height) for width, height in views.sizes_px.tolist()]
    allowed = torch.tensor(
        [
            [_fits(lens, *turned_size(*size, quarters)) for quarters in range(4)]
            for lens, size in zip(model.lenses, sizes, strict=True)
        ]
    ).reshape(-1, 4)
    for name, lens, size, fits in zip(model.names, model.lenses, sizes, allowed, strict=True):
        if not bool(fits.any()):
            raise _other_shape(name, lens, size, "whichever way it is turned")
    return allowed


def _fits(lens: Lens, width: int, height: int) -> bool:
    """Tell whether a resize alone leads from the model's picture to one of this size."""
    # Rounding a side to whole pixels changes the shape by less than this.
    ratio = width / lens.width / (height / lens.height)
    return abs(ratio - 1) <= max(0.01, 2 / min(width, height))


def _exif_turns(views: Views) -> Int[Tensor, " view"]:
    """Give the clockwise quarters that EXIF turned each photograph by; -1 where it mirrored it."""
    tags = [1] * views.num_views if views.orientations is None else views.orientations.tolist()
    return torch.tensor([QUARTERS.get(tag, -1) for tag in tags])


def _hypotheses(
    exif: Int[Tensor, " view"], allowed: Bool[Tensor, "view 4"]
) -> tuple[Int[Tensor, " view"], Int[Tensor, " view"]]:
    """Give the turns of a model of the photographs as they are, and as their files store them."""
    first = allowed.long().argmax(dim=1)
    as_stored = (exif >= 0) & allowed[torch.arange(len(exif)), exif]
    stored = torch.where(as_stored, exif, first)
    return torch.where(allowed[:, 0], 0, stored), stored


def _better(
    squares: Squares, upright: Int[Tensor, " view"], stored: Int[Tensor, " view"]
) -> tuple[Int[Tensor, " view"], bool]:
    """Take the turns with which more agrees; tell whether that is sure."""
    changed = (upright != stored)[squares.view]
    if torch.equal(upright, stored):
        return upright, True
    one, other = (_own(squares, turns)[changed] for turns in (upright, stored))
    errors = _errors(other - one)
    return (stored if errors > _ERRORS else upright), abs(errors) > _ERRORS


def _own(squares: Squares, turns: Int[Tensor, " view"]) -> Float[Tensor, " observation"]:
    return squares.agreement(turns)[torch.arange(len(squares.view)), turns[squares.view]]


def _errors(differences: Float[Tensor, " observation"]) -> float:
    """Give a mean in standard errors; 0 of too few."""
    if len(differences) < _FEWEST:
        return 0.0
    error = differences.std() / len(differences) ** 0.5
    return float(differences.mean() / error.clamp_min(1e-9))


def _each(
    squares: Squares, turns: Int[Tensor, " view"], allowed: Bool[Tensor, "view 4"]
) -> Int[Tensor, " view"]:
    """Turn single views with which the others agree much better another way round."""
    for _ in range(_SWEEPS):
        found, scores = turns.clone(), squares.agreement(turns)
        gains: dict[int, tuple[float, int]] = {}
        for view, fits in enumerate(allowed):
            mine = scores[squares.view == view]
            means = mine.mean(dim=0).masked_fill(~fits, -torch.inf) if len(mine) else None
            if means is None or int(means.argmax()) == int(turns[view]):
                continue
            best = int(means.argmax())
            if means[best] > _LEAST and _errors(mine[:, best] - mine[:, turns[view]]) > _ERRORS:
                gains[view] = float(means[best] - means[turns[view]]), best
        for view, (_, best) in gains.items():
            found[view] = best
        if torch.equal(found, turns):
            break
        turns = found
    return turns


def _require_sides(
    squares: Squares,
    model: SparseModel,
    sizes: Sequence[tuple[int, int]],
    turns: Int[Tensor, " view"],
    exif: Int[Tensor, " view"],
) -> None:
    """Refuse a quarter turn that nothing tells the side of: neither EXIF nor the points."""
    scores = squares.agreement(turns)
    for view, turn in enumerate(turns.tolist()):
        if turn % 2 == 0 or turn == int(exif[view]):
            continue
        mine = scores[squares.view == view]
        if _errors(mine[:, turn] - mine[:, (turn + 2) % 4]) <= _ERRORS:
            raise _other_shape(
                model.names[view],
                model.lenses[view],
                sizes[view],
                "and neither EXIF nor the model's points tell how it was turned",
            )


def _other_shape(name: str, lens: Lens, size: tuple[int, int], why: str) -> InputError:
    return InputError(
        f"{name} is {size[0]}x{size[1]}, but the COLMAP model's camera for it is "
        f"{lens.width}x{lens.height}, which is another shape, {why}. Give the photographs the "
        "model was made from, resized if you like, but neither cropped nor turned."
    )


def _tell(
    model: SparseModel, views: Views, turns: Int[Tensor, " view"], where: str, *, sure: bool
) -> None:
    """Say which way round was taken for how many photographs."""
    turned = {
        90 * quarters: [model.names[view] for view in (turns == quarters).nonzero()[:, 0].tolist()]
        for quarters in (1, 2, 3)
    }
    told = "; ".join(
        f"{len(names)} by {degrees} degrees clockwise ({some(names, 4)})"
        for degrees, names in turned.items()
        if names
    )
    if told:
        number = int((turns > 0).sum())
        caution(
            f"{where} was made of pictures that stand otherwise than the "
            "photographs, such as the pixels that files store before EXIF turns them. Its cameras "
            f"and observations are turned for {number} of {model.num_views} photographs: {told}.",
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
    excess = _own(squares, turns) - squares.chance(turns)
    told = excess[excess != 0]
    if len(told) < _TELLING or _errors(told) > _ERRORS:
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
    axes = _axes(some, views)
    patterns = torch.zeros(len(some.observation_view), 4, (2 * _REACH + 1) ** 2)
    for view in range(model.num_views):
        here = (some.observation_view == view).nonzero()[:, 0]
        points = some.observation_point[here]
        ends = torch.cat([some.points_world[points, None], axes[points]], dim=1)
        lens = some.lenses[view]
        rays = transform(some.cam_from_world[view], ends.reshape(-1, 3))
        pixels = colmap.distort(lens, rays).reshape(-1, 3, 2)
        width, height = (int(side) for side in views.sizes_px[view])
        picture = views.images[view, :, :height, :width].mean(dim=0).detach().cpu().double()
        for quarters in allowed[view].nonzero()[:, 0].tolist():
            before = turned_size(width, height, quarters)
            scale = pixels.new_tensor([before[0] / lens.width, before[1] / lens.height])
            centers = turned_pixels(some.observation_pixels[here] * scale, *before, quarters)
            sides = turned_vectors((pixels[:, 1:] - pixels[:, :1]) * scale, quarters)
            patterns[here, quarters] = _sampled(picture, centers, sides).float()
    return Squares(point=some.observation_point, view=some.observation_view, patterns=patterns)


def _axes(model: SparseModel, views: Views) -> Float[Tensor, "point 2 3"]:
    """Give, of each point, the ends of two steps across its mean viewing direction.

    On average over its views a step is as long as samples are apart in the photographs.
    """
    point, view = model.observation_point, model.observation_view
    pose = model.cam_from_world[view]
    points = model.points_world[point]
    depth = (pose[:, 2, :3] * points).sum(dim=1) + pose[:, 2, 3]
    centers = -(pose[:, :3, :3].mT @ pose[:, :3, 3:])[..., 0]
    towards = normalize(points - centers, dim=1)
    count = len(model.points_world)
    mean = towards.new_zeros(count, 3).index_add(0, point, towards)
    focal = torch.stack(
        [
            colmap.pinhole_of(lens)[0, 0] * max(size) / max(lens.width, lens.height)
            for lens, size in zip(model.lenses, views.sizes_px.tolist(), strict=True)
        ]
    )
    length = towards.new_zeros(count).index_add(0, point, depth.abs() / focal[view])
    length = length / torch.bincount(point, minlength=count).clamp_min(1)
    mean = normalize(mean, dim=1)
    least = one_hot(mean.abs().argmin(dim=1), 3).to(mean)
    first = normalize(torch.linalg.cross(mean, least), dim=1)
    second = torch.linalg.cross(mean, first)
    steps = _STEP_PX * length[:, None, None] * torch.stack([first, second], dim=1)
    return model.points_world[:, None] + steps


def _sampled(
    picture: Float[Tensor, "height width"],
    centers: Float[Tensor, "observation 2"],
    sides: Float[Tensor, "observation 2 2"],
) -> Float[Tensor, "observation sample"]:
    """Sample squares along two sides, without their mean and with unit length."""
    height, width = picture.shape
    along = torch.arange(-_REACH, _REACH + 1, dtype=centers.dtype)
    raster = torch.cartesian_prod(along, along)
    places = centers[:, None] + raster @ sides
    grid = grid_from_pixels(places, width, height)
    found = grid_sample(picture[None, None], grid[None], align_corners=False)[0, 0]
    found = found.clamp_min(0).sqrt()
    inside = ((grid.abs() <= 1).all(dim=-1)).all(dim=-1, keepdim=True)  # false for NaN
    found = torch.where(inside, found, 0)
    patterns = found - found.mean(dim=1, keepdim=True)
    told = patterns.norm(dim=1, keepdim=True) > 1e-3 * found.norm(dim=1, keepdim=True)
    return torch.where(told, normalize(patterns, dim=1), 0)
