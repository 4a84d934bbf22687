"""Photographs as resized, turned or cropped versions of the pictures that cameras are of.

COLMAP works on the pixels of files, which EXIF may say are to be turned; photographs are turned
when they are read. Sizes tell a quarter turn, but not a half; nor do they tell a crop from a
resize, nor camera raw, whose margins JPEG leaves out. Points tell: what is round a point in one
photograph is round it in the others that observe it, if each is taken the way the model has it,
and less so beside it.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample, normalize, one_hot

from pimper_torch.ground.geometry.lens_models import distort, pinhole_of
from pimper_torch.ground.geometry.pixels import grid_from_pixels
from pimper_torch.ground.geometry.rigid import transform
from pimper_torch.method.sfm.conventions.choice import surely_better
from pimper_torch.method.sfm.lenses import QUARTERS, cropped_lens, turned_size
from pimper_torch.method.sfm.model import SparseModel, longest_tracks
from pimper_torch.records import Views
from pimper_torch.runtime.errors import InputError, caution, some
from pimper_torch.runtime.mapped import drop_pages

Size = tuple[int, int]

# Photographs are shifted by so much for comparison. Of photographs of potatoes, mug, jar and balls
# (8 and 12 views of 240x180 and 320x240) that were cropped to 0.95 to 0.5 of their size, of the
# shifts about a resize one at least is worse by 1.5 standard errors at most; about the truth all
# are by 4.9 and more.
REACHES = (4.0, 8.0)


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


def possible_turns(model: SparseModel, views: Views) -> list[tuple[int, ...]]:
    """List the clockwise quarters by which a model's pictures may be turned in the photographs.

    Pictures are the photographs as they stand, then as their files store them; without repetition,
    and none where no resize leads to a photograph's shape.

    Raises:
        InputError: A shape tells a quarter turn, and EXIF does not tell which.
    """
    tags = [1] * views.num_views if views.orientations is None else views.orientations.tolist()
    upright, stored = [], []
    for name, lens, (width, height), tag in zip(
        model.names, model.lenses, views.sizes_px.tolist(), tags, strict=True
    ):
        allowed = [
            quarters
            for quarters in range(4)
            if resize_fits((lens.width, lens.height), *turned_size(width, height, quarters))
        ]
        if not allowed:
            return []
        exif = QUARTERS.get(tag, 0)
        if 0 not in allowed and exif not in allowed:
            raise InputError(
                f"{name} is {width}x{height}, but the camera for it is {lens.width}x{lens.height}, "
                "which is another shape, and EXIF does not tell how it was turned. Give the "
                "photographs the model was made from, resized if you like, but neither cropped "
                "nor turned."
            )
        upright.append(0 if 0 in allowed else exif)
        stored.append(exif if exif in allowed else 0)
    return list(dict.fromkeys((tuple(upright), tuple(stored))))


def choose_turned(ways: Sequence[SparseModel], views: Views, where: str) -> SparseModel:
    """Choose between cameras of photographs as they stand, and as their files store them.

    Args:
        ways: One or two models in the pixels of the photographs, which differ in turns alone.
    """
    if len(ways) > 1:
        upright, stored = (correlations(longest_tracks(model, 40), views)[0] for model in ways)
        if surely_better(stored, upright):
            return ways[1]
        if not surely_better(upright, stored):
            tell_open_turns(where, "points")
    return ways[0]


def tell_turned(where: str, evidence: str) -> None:
    """Warn that cameras were turned with the photographs."""
    caution(
        f"{where}: its cameras are of pictures that stand otherwise than the photographs, such as "
        f"the pixels that files store before EXIF turns them. They are turned with these, as "
        f"{evidence} tells.",
        stacklevel=5,
    )


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
        changed: Numbers of those whose place is in question.
        reaches_px: How far they are shifted for comparison, one distance after the other.
    """
    if not len(model.points_world):
        return 0.0
    chosen = longest_tracks(model, 400)
    mine = torch.isin(chosen.observation_view, torch.tensor(changed))
    for reach_px in reaches_px:
        shifts = reach_px * torch.cat([torch.zeros(1, 2), around(chosen.points_world)])
        own = correlations(chosen, views, shifts, changed)
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


def _within(where: str) -> str:
    return where.replace("The ", "the ", 1)


# Samples to either side of a point, and pixels from one to the next.
_REACH, _STEP_PX = 3, 1.5


def correlations(
    model: SparseModel,
    views: Views,
    shifts: Float[Tensor, "way 2"] | None = None,
    moved: Collection[int] = (),
) -> Float[Tensor, "way observation"]:
    """Correlate each observation's square with the mean of its point's others.

    Args:
        model: In the pixels of the views, in their order.
        shifts: Of some views, the way their squares are moved.
        moved: Numbers of these views.

    Returns:
        0 where a square tells nothing.
    """
    shifts = torch.zeros(1, 2) if shifts is None else shifts
    sides = _sides(model)
    squares = torch.zeros(len(shifts), len(sides), (2 * _REACH + 1) ** 2)
    for view, (width, height) in enumerate(views.sizes_px.tolist()):
        here = (model.observation_view == view).nonzero()[:, 0]
        picture = views.images[view, :, :height, :width]
        centers = model.observation_pixels[here] + (view in moved) * shifts[:, None]
        squares[:, here] = squares_in(picture, centers, sides[here][None])
        drop_pages()
    point = model.observation_point
    count = int(point.max()) + 1 if len(point) else 0
    sums = squares.new_zeros(len(shifts), count, squares.shape[-1]).index_add(-2, point, squares)
    others = normalize(sums[..., point, :] - squares, dim=-1)
    return (squares * others).sum(dim=-1)


def _sides(model: SparseModel) -> Float[Tensor, "observation 2 2"]:
    """Compute the sides of each observation's square, a step long, in pixels."""
    axes = _axes(model)
    sides = model.points_world.new_empty(len(model.observation_view), 2, 2)
    for view, lens in enumerate(model.lenses):
        here = model.observation_view == view
        points = model.observation_point[here]
        ends = torch.cat([model.points_world[points, None], axes[points]], dim=1)
        rays = transform(model.cam_from_world[view], ends.reshape(-1, 3))
        pixels = distort(lens, rays).reshape(-1, 3, 2)
        sides[here] = pixels[:, 1:] - pixels[:, :1]
    return sides


def squares_in(
    picture: Float[Tensor, "channel height width"],
    centers: Float[Tensor, "*way observation 2"],
    sides: Float[Tensor, "*#way observation 2 2"],
) -> Float[Tensor, "*way observation sample"]:
    """Sample squares along two sides, without their mean and with unit length.

    Returns:
        Float32; zero where a square reaches beyond the picture or shows nothing.
    """
    height, width = picture.shape[1:]
    along = torch.arange(-_REACH, _REACH + 1, dtype=centers.dtype)
    raster = torch.cartesian_prod(along, along)
    grid = grid_from_pixels(centers[..., None, :] + raster @ sides, width, height)
    places = grid.reshape(1, 1, -1, 2).to(picture)
    found = grid_sample(picture[None].detach(), places, align_corners=False)[0, :, 0].mean(dim=0)
    found = found.cpu().clamp_min(0).sqrt().reshape(grid.shape[:-1])
    inside = ((grid.abs() <= 1).all(dim=-1)).all(dim=-1, keepdim=True)  # false for NaN
    found = torch.where(inside, found, 0)
    patterns = found - found.mean(dim=-1, keepdim=True)
    told = patterns.norm(dim=-1, keepdim=True) > 1e-3 * found.norm(dim=-1, keepdim=True)
    return torch.where(told, normalize(patterns, dim=-1), 0).float()


def _axes(model: SparseModel) -> Float[Tensor, "point 2 3"]:
    """Return, of each point, the ends of two steps across its mean viewing direction.

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
    focal = torch.stack([pinhole_of(lens)[0, 0] for lens in model.lenses])
    length = towards.new_zeros(count).index_add(0, point, depth.abs() / focal[view])
    length = length / torch.bincount(point, minlength=count).clamp_min(1)
    mean = normalize(mean, dim=1)
    least = one_hot(mean.abs().argmin(dim=1), 3).to(mean)
    first = normalize(torch.linalg.cross(mean, least), dim=1)
    second = torch.linalg.cross(mean, first)
    steps = _STEP_PX * length[:, None, None] * torch.stack([first, second], dim=1)
    return model.points_world[:, None] + steps
