"""Photographs that were cropped since a model was made of them, or that reach beyond its pictures.

Sizes alone do not tell a crop from a resize. Points do: what is round them agrees between views
where the principal point is right. So do the margins of camera raw, which JPEG leaves out.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from pimper_torch.errors import InputError, caution, some
from pimper_torch.records import Views
from pimper_torch.sfm.colmap import pinhole_of
from pimper_torch.sfm.model import SparseModel, longest_tracks
from pimper_torch.sfm.quarter_turns import (
    QUARTERS,
    cropped_lens,
    turned_pixels,
    turned_size,
    turned_vectors,
)
from pimper_torch.sfm.squares import (
    ERRORS,
    SAMPLES,
    others_of,
    sides_of,
    squares_in,
    standard_errors,
)

# Points of each view in the search, and in what is made of it. Of potatoes in 8 views of 240x180,
# cropped by 20 px, the best shift is a pixel off with 40, and right with 400: choices.
_FEW, _MANY = 40, 400
# Pixels from one shift to the next in the first search, of pictures halved until they are so many
# along an axis, or too small; shifts at a time: choices.
_STEP_PX, _STEPS, _SMALLEST_PX, _AT_ONCE = 3, 12, 48, 64
# Steps in a row: a choice that no search came near.
_MOST_STEPS = 12
# A shift that is off by so much of the picture, and 4 px at least, must be worse: choices. Where
# photographs of potatoes, mug, jar and balls (8 and 12 views of 240x180 and 320x240) were cropped
# to 0.95 to 0.5 of their size, of the shifts about a resize one at least is worse by 1.5 standard
# errors at most; about the crop all are by 4.9 and more, at twice the reach where texture is large.
_SHARP, _SHARP_PX = 0.01, 4.0
# Correlation above chance: at crops of these scenes 0.37 to 0.87, of another object's photographs
# up to 0.28.
_LEAST = 0.2
# By so much the shift that was found is off where the object is a glossy mug; else by 1 px.
_ROUND_PX = 3.0

Size = tuple[int, int]


# Where photographs were cut out of the model's pictures, in several ways, and the size of that.
_Cut = tuple[Float[Tensor, "way 2"], Size]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Group:
    """Views of one size of the model's pictures and one of photographs, in their orientation.

    Attributes:
        whole: Of the model's pictures.
        size: Of the photographs, before they were shrunk on reading.
        shrunk: So many pixels of that are one of what was read.
        views: Their numbers.
    """

    whole: Size
    size: Size
    shrunk: float
    views: tuple[int, ...]

    @property
    def room(self) -> Float[Tensor, "2"]:
        """The largest shift; negative where photographs reach beyond."""
        return torch.tensor(self.whole, dtype=torch.float64) - torch.tensor(self.size)

    @property
    def bounds(self) -> Float[Tensor, "2 2"]:
        """The smallest and the largest shift."""
        return torch.stack([self.room.clamp_max(0), self.room.clamp_min(0)])


@dataclass(frozen=True, slots=True, kw_only=True)
class _Points:
    """Points, and the photographs that they are looked for in, halved ``level`` times."""

    model: SparseModel
    views: Views
    quarters: tuple[int, ...]
    sides: Float[Tensor, "observation 2 2"]
    pictures: tuple[Float[Tensor, "channel _ _"], ...]
    level: int = 0

    @classmethod
    def of(cls, model: SparseModel, views: Views, quarters: Sequence[int], most: int) -> "_Points":
        """Choose so many of each view."""
        chosen = longest_tracks(model, most)
        return cls(
            model=chosen,
            views=views,
            quarters=tuple(quarters),
            sides=sides_of(chosen, views),
            pictures=tuple(
                image[:, :height, :width]
                for image, (width, height) in zip(
                    views.images, views.sizes_px.tolist(), strict=True
                )
            ),
        )

    def at(self, level: int) -> "_Points":
        """Halve the photographs."""
        grey = (picture.detach().mean(dim=0, keepdim=True) for picture in self.pictures)
        smaller = tuple(avg_pool2d(one, 2**level) for one in grey) if level else self.pictures
        return replace(self, pictures=smaller, level=level)

    def agreement(
        self, views: Sequence[int], cuts: Mapping[int, _Cut]
    ) -> tuple[Float[Tensor, "way mine"], Float[Tensor, "way mine"]]:
        """Correlate some views' observations with all others of their points, and of another.

        Args:
            views: Numbers of these views.
            cuts: Of the photographs that take part.
        """
        ways = max(len(shift) for shift, _ in cuts.values())
        squares = torch.zeros(ways, len(self.sides), SAMPLES)
        for view, (shift, size) in cuts.items():
            here = (self.model.observation_view == view).nonzero()[:, 0]
            turns, before = self.quarters[view], self._before(view)
            pixels = self.model.observation_pixels[here] - shift[:, None]
            pixels = pixels * (pixels.new_tensor(before) / pixels.new_tensor(size))
            centers = turned_pixels(pixels, *before, turns) / 2**self.level
            across = turned_vectors(self.sides[here], turns)
            squares[:, here] = squares_in(self.pictures[view], centers, across)
        others, strangers = others_of(squares, self.model.observation_point)
        mine = torch.isin(self.model.observation_view, torch.tensor(views))
        return (squares * others).sum(dim=-1)[:, mine], (squares * strangers).sum(dim=-1)[:, mine]

    def _before(self, view: int) -> Size:
        width, height = (int(side) for side in self.views.sizes_px[view])
        return turned_size(width, height, self.quarters[view])


def follow_crops(
    model: SparseModel, views: Views, sizes_px: Sequence[Size], where: str
) -> SparseModel:
    """Cut a model's pictures where photographs were cut out of them; a constant to autograd.

    Photographs of one size share the crop. That they were resized is the plain explanation: a crop
    must agree better.

    Args:
        model: Its views are the photographs, in their order.
        sizes_px: Their sizes before they were shrunk on reading.
        where: The model is, for messages, as a sentence starts.

    Returns:
        Lenses of the sizes of cropped photographs, principal points and observations shifted, and
        a :class:`~pimper_torch.errors.PimperWarning`. All else is as it was, so that photographs of
        another shape that nothing explains can be refused.

    Raises:
        InputError: Photographs were cropped, and points do not tell where.
    """
    quarters = _quarters(model, sizes_px, views)
    groups = _groups(model, sizes_px, quarters, views)
    changed = [group for group in groups if group.whole != group.size]
    if not changed or not len(model.observation_view):
        return model
    few, many = (_Points.of(model, views, quarters, count) for count in (_FEW, _MANY))
    still = torch.zeros(1, 2, dtype=torch.float64)
    cuts: dict[int, _Cut] = {
        view: (still, group.whole)
        for group in groups
        if group.whole == group.size
        for view in group.views
    }
    for group in changed:
        shift = _shift(group, few, many, cuts, where)
        cuts |= dict.fromkeys(
            group.views, (still, group.whole) if shift is None else (shift[None], group.size)
        )
        if shift is not None:
            model = cut(model, group.views, group.size, shift)
            tell_crop(where, model, group.views, _EVIDENCE)
    return model


def possible_crops(model: SparseModel, views: Views, sizes_px: Sequence[Size]) -> list[SparseModel]:
    """Cut the pictures of a model without points in the usual ways; none where no size differs.

    Takes what :func:`follow_crops` takes.

    Returns:
        Photographs from the middle, then from the borders and corners.
    """
    groups = _groups(model, sizes_px, _quarters(model, sizes_px, views), views)
    changed = [group for group in groups if group.whole != group.size]
    ways = []
    for place in torch.tensor([0.5, 0.0, 1.0])[torch.cartesian_prod(*[torch.arange(3)] * 2)]:
        way = model
        for group in changed:
            way = cut(way, group.views, group.size, place * group.room)
        ways.append(way)
    return ways if changed else []


def resize_fits(whole: Size, width: int, height: int) -> bool:
    """Return whether a resize alone leads from a picture of one size to one of another."""
    # Rounding a side to whole pixels changes the shape by less than this.
    ratio = width / whole[0] / (height / whole[1])
    return abs(ratio - 1) <= max(0.01, 2 / min(width, height))


def cut(
    model: SparseModel, views: Sequence[int], size: Size, shift: Float[Tensor, "2"]
) -> SparseModel:
    """Cut the pictures of some views: their lenses and observations follow, as another camera's.

    Args:
        size: Width and height of what is cut out.
        shift: Its corner, pixels of the pictures.
    """
    fresh = max(lens.camera for lens in model.lenses)
    lenses = list(model.lenses)
    for view in views:
        lens = cropped_lens(lenses[view], *size, shift)
        lenses[view] = lens.replace(camera=fresh + lens.camera)
    here = torch.isin(model.observation_view, torch.tensor(views))
    pixels = torch.where(here[:, None], model.observation_pixels - shift, model.observation_pixels)
    return model.replace(lenses=tuple(lenses), observation_pixels=pixels)


def shifted_lenses(
    model: SparseModel, views: Sequence[int], shift: Float[Tensor, "2"]
) -> SparseModel:
    """Move the pictures of some views; sizes, observations and numbers of cameras stay."""
    lenses = list(model.lenses)
    for view in views:
        lenses[view] = cropped_lens(lenses[view], lenses[view].width, lenses[view].height, shift)
    return model.replace(lenses=tuple(lenses))


def _quarters(model: SparseModel, sizes_px: Sequence[Size], views: Views) -> list[int]:
    """Turn photographs as EXIF does where the model's pictures lie across them otherwise."""
    tags = [1] * views.num_views if views.orientations is None else views.orientations.tolist()
    return [
        QUARTERS.get(tag, 0) if (width > height) != (lens.width > lens.height) else 0
        for tag, (width, height), lens in zip(tags, sizes_px, model.lenses, strict=True)
    ]


def _groups(
    model: SparseModel, sizes_px: Sequence[Size], quarters: Sequence[int], views: Views
) -> list[_Group]:
    """Group views by sizes, the largest group first."""
    groups: dict[tuple[Size, Size], list[int]] = {}
    for view, (lens, size) in enumerate(zip(model.lenses, sizes_px, strict=True)):
        key = (lens.width, lens.height), turned_size(*size, quarters[view])
        groups.setdefault(key, []).append(view)
    found = [
        _Group(
            whole=whole,
            size=size,
            shrunk=max(size) / int(views.sizes_px[members[0]].max()),
            views=tuple(members),
        )
        for (whole, size), members in groups.items()
    ]
    return sorted(found, key=lambda group: -len(group.views))


def _shift(
    group: _Group, few: _Points, many: _Points, cuts: Mapping[int, _Cut], where: str
) -> Float[Tensor, "2"] | None:
    """Find where photographs were cut out of the model's pictures; ``None`` where they were not."""

    def agreement(
        points: _Points, shifts: Float[Tensor, "way 2"], size: Size = group.size
    ) -> tuple[Float[Tensor, "way mine"], Float[Tensor, "way mine"]]:
        mine = dict.fromkeys(group.views, (shifts, size))
        return points.agreement(group.views, {**cuts, **mine})

    def best(points: _Points, shifts: Float[Tensor, "way 2"]) -> Float[Tensor, "2"]:
        scores = [agreement(points, part)[0] for part in torch.split(shifts, _AT_ONCE)]
        own = torch.cat(scores)
        count = (own != 0).sum(dim=1).clamp_min(own.shape[1] / 4)
        return shifts[(own.sum(dim=1) / count).argmax()]

    def sharp(
        own: Float[Tensor, " mine"], shift: Float[Tensor, "2"], size: Size, reach_px: float
    ) -> bool:
        """Return whether photographs that are placed a little beside agree worse."""
        reach = max(reach_px * group.shrunk, _SHARP * max(group.size))
        beside = agreement(many, shift + reach * around(shift), size)[0]
        seen = own != 0
        return min(standard_errors((own - one)[seen]) for one in beside) > ERRORS

    still, (shifts, level) = torch.zeros_like(group.room), _first(group)
    resized = agreement(many, still[None], group.whole)[0][0]
    fits = resize_fits(group.whole, *group.size)
    if fits and len(shifts) > _AT_ONCE and sharp(resized, still, group.whole, _SHARP_PX):
        return None  # without a long search
    shift = best(few.at(level), shifts)
    for finer in range(level, -1, -1):
        step = round(2**finer * group.shrunk)
        shift = climbed(shift.round(), step, partial(best, few.at(finer)), group.bounds)
    shift = climbed(shift, round(group.shrunk), partial(best, many), group.bounds)
    own, chance = (one[0] for one in agreement(many, shift[None]))
    seen = own != 0
    better = standard_errors((own - resized)[seen])
    if fits and better <= ERRORS:
        return None
    if float((own - chance)[seen].mean()) < _LEAST:
        return None
    if any(sharp(own, shift, group.size, reach * _SHARP_PX) for reach in (1, 2)):
        return _plain(group, shift)
    if not fits:
        return None
    raise refused_crop(where, few.model, group.views, _EVIDENCE)


def around(like: Tensor) -> Float[Tensor, "8 2"]:
    """List the steps to the neighbours of a pixel."""
    steps = torch.tensor([-1, 0, 1]).to(like)
    ring = torch.cartesian_prod(steps, steps)
    return ring[ring.abs().sum(dim=1) > 0]


def _first(group: _Group) -> tuple[Float[Tensor, "way 2"], int]:
    """List the shifts of the first search, and how often photographs are halved for it."""
    room = group.room.abs() / group.shrunk
    wanted = math.log2(max(1.0, float(room.max()) / (_STEP_PX * _STEPS)))
    most = math.log2(max(1.0, min(group.size) / group.shrunk / _SMALLEST_PX))
    level = min(math.ceil(wanted), math.floor(most))
    counts = (room / (_STEP_PX * 2**level)).ceil().long() + 1
    axes = [
        torch.linspace(0, 1, count, dtype=torch.float64) * side
        for count, side in zip(counts.tolist(), group.room, strict=True)
    ]
    return torch.cartesian_prod(*axes), level


def _plain(group: _Group, shift: Float[Tensor, "2"]) -> Float[Tensor, "2"]:
    """Round a shift to the middle or to a border of the picture, on each axis where it is near."""
    usual = torch.stack([0 * group.room, group.room / 2, group.room])
    nearest = usual.gather(0, (usual - shift).abs().argmin(dim=0)[None])[0]
    return torch.where((nearest - shift).abs() <= _ROUND_PX * group.shrunk, nearest, shift)


def climbed(
    shift: Float[Tensor, "2"],
    step: float,
    best: Callable[[Float[Tensor, "way 2"]], Float[Tensor, "2"]],
    bounds: Float[Tensor, "2 2"],
) -> Float[Tensor, "2"]:
    """Step to the best shift round about until none is better.

    Args:
        step: Pixels.
        best: Chooses one of several.
        bounds: Of shifts, the smallest and the largest.
    """
    for _ in range(_MOST_STEPS):
        ring = torch.cat([torch.zeros(1, 2).to(shift), step * around(shift)])
        nearest = best(torch.minimum(torch.maximum(shift + ring, bounds[0]), bounds[1]))
        if torch.equal(nearest, shift):
            break
        shift = nearest
    return shift


_EVIDENCE = "what they show round its points"


def tell_crop(where: str, model: SparseModel, views: Sequence[int], evidence: str) -> None:
    """Warn that photographs are cropped ones, and where the principal point is in the first."""
    lens = model.lenses[views[0]]
    x, y = pinhole_of(lens)[:2, 2].tolist()
    caution(
        f"{where} is of pictures of another size than {_which(model, views)}, and {evidence} tells "
        "that these are no resized ones, but cropped: the principal point is at "
        f"({x:.0f}, {y:.0f}) of {lens.width}x{lens.height}. Cameras and observations follow. If "
        "that is wrong, give the photographs that it was made from.",
        stacklevel=6,
    )


def refused_crop(where: str, model: SparseModel, views: Sequence[int], evidence: str) -> InputError:
    """Refuse photographs that are no resized ones, and of which nothing tells the crop."""
    return InputError(
        f"{where} is of pictures of another size than {_which(model, views)}, and {evidence} fits "
        "a crop better than a resize, but does not tell which crop. Give the photographs that it "
        "was made from, resized if you like, but not cropped."
    )


def _which(model: SparseModel, views: Sequence[int]) -> str:
    names = some([model.names[view] for view in views], 4)
    return f"{len(views)} of {model.num_views} photographs ({names})"
