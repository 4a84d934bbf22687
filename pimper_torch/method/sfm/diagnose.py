"""Whether a model can be believed.

A model can be consistent with every match that it was made of, and wrong: photographs that are
cropped round an object that turns show the room as a camera would that shifts before a wall.
Points that move as if the camera only rotated are explained by any translation of the camera, or by
none: they determine neither depth nor baseline. Those of a plane that is seen from round it move by
homographies that shear, and do.

Where two sides of an object look alike, COLMAP can register every photograph with small
reprojection errors, and put a part of them on the wrong side: a mapper leaves out what contradicts
it. The pairs with most matches are those of neighbouring photographs, and nearly all their matches
agree with a right model; those of a misplaced view do not. Pairs with few matches do not tell: a
third of a carton's disagree with the right model, too, for its sides look alike.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from pimper_torch.ground.geometry.projection import triangulation_angles
from pimper_torch.ground.geometry.rigid import invert_rigid
from pimper_torch.method.sfm.camera_in_place import follows_camera_in_place
from pimper_torch.method.sfm.epipolar import match_errors
from pimper_torch.method.sfm.matching import VerifiedPair
from pimper_torch.method.sfm.model import SparseModel
from pimper_torch.method.sfm.reconstruct_config import MIN_MATCHES
from pimper_torch.runtime.errors import ReconstructionError, some

FEWEST_VIEWS = 3
# Points seen under less are of no use to the coarse surface (coarse/surface.py).
MIN_ANGLE_DEG = 4.0
ADVICE = (
    "Neighbouring photographs should overlap by two thirds and differ by less than about 20 "
    "degrees in viewpoint: add photographs between those that did not register, or give an "
    "existing COLMAP model. Lowering `reconstruct.peak_threshold` finds fainter features."
)
JOINING = (
    "What joins them: photographs of the object's sides from low down in every series, which "
    "show the same surface, turned in steps of 15 degrees; more texture on the object; or masks "
    "(`--masks`)."
)
MOVE = (
    "Where the object turned before a camera that stood still, give masks of the object "
    "(`--masks`), or put a plain cloth behind and below it, so that nothing at rest has features; "
    "or leave the object where it is and move the camera round it."
)


def count_spread_views(model: SparseModel, fewest: int) -> int:
    """Count the views that see enough points under a triangulation angle that determines depth."""
    return int((model.observed[wide_points(model)].sum(dim=0) >= fewest).sum())


def wide_points(model: SparseModel) -> Bool[Tensor, " point"]:
    """Find points whose widest angle between rays is 4 degrees or more."""
    centers = invert_rigid(model.cam_from_world)[:, :3, 3]
    angles = triangulation_angles(model.points_world, model.observed, centers)
    return torch.rad2deg(angles) >= MIN_ANGLE_DEG


def choose_component(
    components: Sequence[tuple[str, ...]],
    spread: Sequence[int],
    names: Sequence[str],
    min_fraction: float,
) -> int:
    """Choose the component to keep: the one with most views that see depth.

    Args:
        spread: Views of each that see depth, see :func:`count_spread_views`.
        min_fraction: Of the photographs that the chosen component must have when another one
            holds at least 3 views that it lacks.

    Returns:
        Index of the component; of equals the one with most views, then the first.

    Raises:
        ReconstructionError: Fewer than 3 views registered or see depth, or there is no clear
            majority.
    """
    order = range(len(components))
    largest = max(order, key=lambda index: (spread[index], len(components[index])), default=-1)
    chosen = components[largest] if components else ()
    if len(chosen) < FEWEST_VIEWS:
        missing = [name for name in names if name not in chosen]
        raise ReconstructionError(
            f"Structure from motion registered {len(chosen)} of {len(names)} photographs; at least "
            f"{FEWEST_VIEWS} are needed. Not registered: {some(missing, most=20)}. {ADVICE}"
        )
    if spread[largest] < FEWEST_VIEWS:
        raise ReconstructionError(
            f"Structure from motion registered {len(chosen)} of {len(names)} photographs, but only "
            f"{spread[largest]} of them see enough points under triangulation angles of "
            f"{MIN_ANGLE_DEG:.0f} degrees or more; at least {FEWEST_VIEWS} are needed. The "
            "cameras were found in nearly one place: they stood still, or they were registered on "
            f"a background at rest. {MOVE}"
        )
    rivals = [
        part
        for part, depth in zip(components, spread, strict=True)
        if depth >= FEWEST_VIEWS and len(set(part) - set(chosen)) >= 3
    ]
    if rivals and len(chosen) < min_fraction * len(names):
        parts = "; ".join(
            f"{len(part)} photographs ({some(part, most=12)})" for part in (chosen, *rivals)
        )
        raise ReconstructionError(
            f"Structure from motion split {len(names)} photographs into {1 + len(rivals)} models "
            f"that nothing ties together: {parts}. One model with at least {min_fraction:.0%} of "
            f"the photographs is needed. {ADVICE} Where the object was turned over between the "
            f"groups, its own features must tie them. {JOINING} Or reconstruct one of the groups "
            "on its own."
        )
    return largest


# Median over views of the points that follow, above which a model is not believed: 0.93 to 0.98 in
# wrong models of 3 turntables whose room shifts, 0.00 to 0.32 in right ones (the skull's 24, 5
# rendered arcs, one of points on a table alone, and 4 turntables).
_MOST_FOLLOWING = 0.5


def diagnose(model: SparseModel, num_photographs: int) -> str:
    """State why the cameras may be wrong, and what to do; empty where nothing does."""
    following = following_fraction(model)
    if following > _MOST_FOLLOWING:
        return (
            f"The cameras are doubtful: {following:.0%} of the points move as if the camera only "
            "rotated, so their depth is undetermined. Either all is flat, or a background that "
            f"shifts was registered in the place of the object. {MOVE}"
        )
    wide = model.observed[wide_points(model)].sum(dim=0)
    seeing = int((wide > model.observed.sum(dim=0) / 2).sum())
    if seeing < num_photographs / 2:
        return (
            f"The cameras are doubtful: {seeing} of {num_photographs} photographs are registered "
            f"and see most of their points under triangulation angles of {MIN_ANGLE_DEG:.0f} "
            f"degrees or more. {ADVICE} {MOVE}"
        )
    return ""


def count_views_with_depth(models: Sequence[SparseModel], fewest: int) -> list[int]:
    """Count, model by model, the views that see depth.

    Returns:
        As :func:`count_spread_views`, but 0 for a model whose points move as if the camera only
        rotated, if another model is left.
    """
    spread = [count_spread_views(model, fewest) for model in models]
    only = len(models) == 1
    moving = [only or following_fraction(model) <= _MOST_FOLLOWING for model in models]
    deep = [count if moves else 0 for count, moves in zip(spread, moving, strict=True)]
    return deep if max(deep, default=0) >= FEWEST_VIEWS else spread


def following_fraction(model: SparseModel) -> float:
    """Return the fraction of points that move as before a camera in one place; median over views.

    Of those that a view shares with a reference, for the reference of which it is the largest.
    """
    seen = [model.observation_view == view for view in range(model.num_views)]
    points, pixels = (
        [values[mine] for mine in seen]
        for values in (model.observation_point, model.observation_pixels)
    )
    everywhere = torch.cat(pixels).double()
    centre = (everywhere.amin(dim=0) + everywhere.amax(dim=0)) / 2
    # 2 px of 800, or 0.09 degrees of parallax with a normal lens.
    max_error_px = 0.0025 * max(max(lens.width, lens.height) for lens in model.lenses)
    generator = torch.Generator().manual_seed(0)
    best = 0.0
    # Three references, evenly over the sequence: one alone may be blurred or covered.
    for reference in sorted({(2 * slot + 1) * model.num_views // 6 for slot in range(3)}):
        fractions = []
        for view in range(model.num_views):
            if view != reference:
                others = points[view]
                here = torch.nonzero(torch.isin(points[reference], others))[:, 0]
                order = others.argsort()
                there = order[torch.searchsorted(others[order], points[reference][here])]
                ends = pixels[view][there], pixels[reference][here]
                follows = follows_camera_in_place(*ends, centre, max_error_px, generator)
                enough = int(follows.sum()) >= MIN_MATCHES
                fractions.append(float(follows.double().mean()) if enough else 0.0)
        best = max(best, float(torch.tensor(fractions or [0.0]).median()))
    return best


# Fraction of the matches in a view's 3 strongest pairs that must agree with the model: 91 to 100 %
# do for the worst view of 4 right models of a carton, 4 to 31 % in 3 wrong models; in its strongest
# pair alone 77 to 100 %, in its 6 strongest 85 to 90 %.
_MIN_AGREEMENT = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchConsistency:
    """Agreement of a model with the verified matches of its photographs.

    Attributes:
        explained: Fraction of all verified matches that the model's epipolar geometry explains;
            matches of photographs that the model lacks are not explained.
        misplaced: By name, views that contradict most matches of their strongest pairs, with the
            fraction that agrees.
    """

    inlier_ratio: float
    misplaced: Mapping[str, float]


def verify_model(
    model: SparseModel, files: Sequence[str], pairs: Sequence[VerifiedPair], max_error_px: float
) -> MatchConsistency:
    """Compare a model with verified matches."""
    view_of = {files.index(name): view for view, name in enumerate(model.names)}
    inside = [
        pair.replace(views=(view_of[pair.views[0]], view_of[pair.views[1]]))
        for pair in pairs
        if all(number in view_of for number in pair.views)
    ]
    agrees = match_errors(model, inside) <= max_error_px
    counts = [pair.num_matches for pair in inside]
    agreeing = {
        pair.views: (pair.num_matches, float(some.double().mean()))
        for pair, some in zip(inside, torch.split(agrees, counts), strict=True)
    }
    misplaced = {}
    for view, name in enumerate(model.names):
        mine = [agreeing[pair] for pair in agreeing if view in pair]
        fraction = _agreeing_fraction(sorted(mine, reverse=True)[:3])
        if fraction < _MIN_AGREEMENT:
            misplaced[name] = fraction
    total = sum(pair.num_matches for pair in pairs)
    compared = sum(count for count, _ in agreeing.values())
    inlier_ratio = _agreeing_fraction(agreeing.values()) * compared / total if total else 0.0
    return MatchConsistency(inlier_ratio=inlier_ratio, misplaced=misplaced)


def _agreeing_fraction(pairs: Collection[tuple[int, float]]) -> float:
    total = sum(count for count, _ in pairs)
    return sum(count * fraction for count, fraction in pairs) / total if total else 1.0


def agreement(model: SparseModel, pair: VerifiedPair, max_error_px: float) -> float:
    """Return the fraction of a pair's matches that the model's epipolar geometry explains."""
    return float((match_errors(model, [pair]) <= max_error_px).double().mean())
