"""Whether a model can be believed.

A model can be consistent with every match that it was made of, and wrong: photographs that are
cropped round an object that turns show the room as a camera would that shifts before a wall.
Points that move as before a camera that stays in its place are explained by any translation of the
camera, or by none: they determine neither depth nor baseline. Those of a plane that is seen from
round it move by homographies that shear, and do.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.sfm.camera_in_place import both_ways, picture_centre, references, tied_to
from pimper_torch.sfm.components import (
    ADVICE,
    FEWEST_VIEWS,
    MIN_ANGLE_DEG,
    MOVE,
    count_spread_views,
    wide_points,
)
from pimper_torch.sfm.model import SparseModel
from pimper_torch.sfm.static_background import Pair

# Points that two views share, below which nothing is said of them.
_FEWEST = 15
# Distance from where such a camera's map takes a point, up to which it follows, in longer sides of
# the photograph: 2 px of 800, or 0.09 degrees of parallax with a normal lens.
_MAX_ERROR = 0.0025
# Median over views of the points that follow, above which a model is not believed: 0.93 to 0.98 in
# wrong models of 3 turntables whose room shifts, 0.00 to 0.32 in right ones (the skull's 24, 5
# rendered arcs, one of points on a table alone, and 4 turntables).
_MOST_FOLLOWING = 0.5
# Fraction of the photographs that must see most of their points under real angles for a model to be
# believed, and fraction of the points: most.
_MOST = 0.5


def doubt(model: SparseModel, num_photographs: int) -> str:
    """State why the cameras may be wrong, and what to do; empty where nothing does."""
    following = following_fraction(model)
    if following > _MOST_FOLLOWING:
        return (
            f"The cameras are doubtful: {following:.0%} of the points move from photograph to "
            "photograph as before a camera that stays in its place, so that nothing tells their "
            "depth. Either all is flat, or a background that shifts was registered in the place "
            f"of the object. {MOVE}"
        )
    seeing = count_deep_views(model)
    if seeing < _MOST * num_photographs:
        return (
            f"The cameras are doubtful: {seeing} of {num_photographs} photographs are registered "
            f"and see most of their points under triangulation angles of {MIN_ANGLE_DEG:.0f} "
            f"degrees or more. {ADVICE} {MOVE}"
        )
    return ""


def count_deep_views(model: SparseModel) -> int:
    """Count the views that see most of their points under triangulation angles that tell depth."""
    wide = model.observed[wide_points(model)].sum(dim=0)
    return int((wide > _MOST * model.observed.sum(dim=0)).sum())


def count_views_with_depth(models: Sequence[SparseModel], fewest: int) -> list[int]:
    """Count, model by model, the views that see depth.

    Args:
        models: Components of one sequence.
        fewest: Points that a view must see under a triangulation angle of 4 degrees or more.

    Returns:
        As :func:`~pimper_torch.sfm.components.count_spread_views`, but 0 for a model whose points
        move as before a camera in its place, where there is another one to go on with.
    """
    spread = [count_spread_views(model, fewest) for model in models]
    moving = [following_fraction(model) <= _MOST_FOLLOWING for model in models]
    deep = [count if moves else 0 for count, moves in zip(spread, moving, strict=True)]
    return deep if max(deep, default=0) >= FEWEST_VIEWS else spread


def following_fraction(model: SparseModel) -> float:
    """Return the fraction of points that move as before a camera in one place; median over views.

    Of those that a view shares with a reference, for the reference of which it is the largest.
    """
    numbers, pixels = _by_view(model)
    centre = picture_centre(pixels)
    max_error_px = _MAX_ERROR * max(max(lens.width, lens.height) for lens in model.lenses)
    generator = torch.Generator().manual_seed(0)
    best = 0.0
    for reference in references(model.num_views):
        pairs = [
            _shared(numbers, reference, view)
            for view in range(model.num_views)
            if view != reference
        ]
        matched = both_ways(pixels, pairs)[reference]
        tied = tied_to(matched, centre, max_error_px, _FEWEST, generator, any_homography=False)
        fractions = torch.zeros(max(model.num_views - 1, 1))
        for slot, (_, follows) in enumerate(tied.values()):
            fractions[slot] = follows.double().mean()
        best = max(best, float(fractions.median()))
    return best


def _by_view(model: SparseModel) -> tuple[list[Tensor], list[Float[Tensor, "_ 2"]]]:
    """Return the points that each view observes, and where."""
    own = [model.observation_view == view for view in range(model.num_views)]
    return (
        [model.observation_point[one] for one in own],
        [model.observation_pixels[one] for one in own],
    )


def _shared(points: list[Tensor], first: int, second: int) -> Pair:
    same = torch.isin(points[first], points[second])
    rows = torch.nonzero(same)[:, 0]
    order = points[second].argsort()
    place = torch.searchsorted(points[second][order], points[first][rows])
    return Pair(first=first, second=second, matches=torch.stack([rows, order[place]], dim=1))
