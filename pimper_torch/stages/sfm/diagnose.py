"""Verification of a model.

A model can agree with all of its matches and still be wrong: photographs cropped around a turning
object show the background as a camera would that shifts in front of a wall. Points that move as if
the camera only rotated fit any translation of the camera, or none: they determine neither depth nor
baseline. Points of a plane seen from all around move by homographies that shear, and determine
both.

If two sides of an object look alike, COLMAP can register every photograph with small reprojection
errors, but some on the wrong side: a mapper drops contradicting matches. The pairs with most
matches are neighbouring photographs. Nearly all their matches agree with a correct model; those of
a misplaced view do not. Pairs with few matches are no evidence: a third of a carton's disagree with
the correct model, because its sides look alike.
"""

from collections.abc import Collection, Sequence

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from pimper_torch.geometry.projection import triangulation_angles
from pimper_torch.geometry.rigid import invert_rigid
from pimper_torch.records.sparse_model import SparseModel
from pimper_torch.runtime.errors import ReconstructionError, some
from pimper_torch.stages.sfm.camera_in_place import follows_camera_in_place
from pimper_torch.stages.sfm.epipolar import match_errors
from pimper_torch.stages.sfm.matching import VerifiedPair
from pimper_torch.stages.sfm.reconstruct_config import MIN_MATCHES

FEWEST_VIEWS = 3
# The coarse surface does not use points below this angle (coarse/surface.py).
MIN_ANGLE_DEG = 4.0
ADVICE = (
    "Neighbouring photographs should overlap by two thirds and differ by less than about 20 "
    "degrees in viewpoint: add photographs between those that did not register, or give an "
    "existing COLMAP model. Lower `reconstruct.peak_threshold` to find fainter features."
)
JOINING = (
    "To join them, photograph the object's sides from low down in every session, in steps of 15 "
    "degrees, so that they show the same surface; add texture to the object; or give masks "
    "(`--masks`)."
)
MOVE = (
    "If the object turned in front of a static camera, give masks of the object (`--masks`), or "
    "put a plain cloth behind and below it, so that the background has no features; or leave the "
    "object in place and move the camera around it."
)


def count_spread_views(model: SparseModel, fewest: int) -> int:
    """Count the views with enough points under triangulation angles that determine depth."""
    return int((model.observed[wide_points(model)].sum(dim=0) >= fewest).sum())


def wide_points(model: SparseModel) -> Bool[Tensor, " point"]:
    """Return the points with a widest angle of 4 degrees or more between rays."""
    centers = invert_rigid(model.cam_from_world)[:, :3, 3]
    angles = triangulation_angles(model.points_world, model.observed, centers)
    return torch.rad2deg(angles) >= MIN_ANGLE_DEG


def choose_component(
    components: Sequence[tuple[str, ...]],
    spread: Sequence[int],
    names: Sequence[str],
    min_fraction: float,
) -> int:
    """Choose the component with most views that see depth.

    Args:
        spread: Number of views of each that see depth, see :func:`count_spread_views`.
        min_fraction: Least fraction of the photographs in the chosen component if a different one
            contains at least 3 views that it lacks.

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
            "cameras are at nearly one position: they did not move, or were registered on a "
            f"static background. {MOVE}"
        )
    rivals = [
        group
        for group, depth in zip(components, spread, strict=True)
        if depth >= FEWEST_VIEWS and len(set(group) - set(chosen)) >= 3
    ]
    if rivals and len(chosen) < min_fraction * len(names):
        parts = "; ".join(
            f"{len(group)} photographs ({some(group, most=12)})" for group in (chosen, *rivals)
        )
        raise ReconstructionError(
            f"Structure from motion split {len(names)} photographs into {1 + len(rivals)} models "
            f"without common points: {parts}. One model with at least {min_fraction:.0%} of the "
            f"photographs is needed. {ADVICE} If the object was turned over between the groups, "
            f"only its own features can link them. {JOINING} Or reconstruct each group alone."
        )
    return largest


# Largest result of following_fraction for a plausible model: 0.93 to 0.98 in wrong models of 3
# turntables with a shifting background, 0.00 to 0.32 in correct ones (the skull's 24, 5 rendered
# arcs, one of points on a table alone, and 4 turntables).
_MOST_FOLLOWING = 0.5


def diagnose(model: SparseModel, num_photographs: int) -> str:
    """Return why the cameras may be wrong, and a remedy; empty for a plausible model."""
    following = following_fraction(model)
    if following > _MOST_FOLLOWING:
        return (
            f"The cameras are unreliable: {following:.0%} of the points move as if the camera only "
            "rotated, so their depth is undetermined. Either the scene is flat, or a shifting "
            f"background was registered instead of the object. {MOVE}"
        )
    wide = model.observed[wide_points(model)].sum(dim=0)
    deep = int((wide > model.observed.sum(dim=0) / 2).sum())
    if deep < num_photographs / 2:
        return (
            f"The cameras are unreliable: {deep} of {num_photographs} photographs are registered "
            f"and see most of their points under triangulation angles of {MIN_ANGLE_DEG:.0f} "
            f"degrees or more. {ADVICE} {MOVE}"
        )
    return ""


def count_views_with_depth(models: Sequence[SparseModel], fewest: int) -> list[int]:
    """Count, model by model, the views that see depth.

    Returns:
        As :func:`count_spread_views`, but 0 for a model whose points move as if the camera only
        rotated, if other models remain.
    """
    spread = [count_spread_views(model, fewest) for model in models]
    only = len(models) == 1
    moving = [only or following_fraction(model) <= _MOST_FOLLOWING for model in models]
    deep = [count if moves else 0 for count, moves in zip(spread, moving, strict=True)]
    return deep if max(deep, default=0) >= FEWEST_VIEWS else spread


def following_fraction(model: SparseModel) -> float:
    """Return the fraction of points that move as if the camera only rotated; median over views.

    It is relative to the points that a view shares with a reference view; of three references, the
    largest value counts.
    """
    in_view = [model.observation_view == view for view in range(model.num_views)]
    points, pixels = (
        [values[index] for index in in_view]
        for values in (model.observation_point, model.observation_pixels)
    )
    everywhere = torch.cat(pixels).double()
    centre = (everywhere.amin(dim=0) + everywhere.amax(dim=0)) / 2
    # 2 px of 800, or 0.09 degrees of parallax with a normal lens.
    max_error_px = 0.0025 * max(max(lens.width, lens.height) for lens in model.lenses)
    largest = 0.0
    # Three references, evenly over the sequence: a single one may be blurred or covered.
    for reference in sorted({(2 * slot + 1) * model.num_views // 6 for slot in range(3)}):
        fractions = []
        for view in range(model.num_views):
            if view != reference:
                both = np.intersect1d(points[view], points[reference], return_indices=True)
                ends = pixels[view][both[1]], pixels[reference][both[2]]
                follows = follows_camera_in_place(*ends, centre, max_error_px)
                enough = int(follows.sum()) >= MIN_MATCHES
                fractions.append(float(follows.double().mean()) if enough else 0.0)
        largest = max(largest, float(torch.tensor(fractions or [0.0]).median()))
    return largest


# Least fraction of the matches in a view's 3 strongest pairs that agree with the model: 91 to 100 %
# for the worst view of 4 correct models of a carton, 4 to 31 % in 3 wrong models; in its strongest
# pair alone 77 to 100 %, in its 6 strongest 85 to 90 %.
_MIN_AGREEMENT = 0.5


def pairs_in(
    model: SparseModel, names: Sequence[str], pairs: Sequence[VerifiedPair]
) -> list[VerifiedPair]:
    """Return the pairs of a model's photographs, with numbers of its views instead of ``names``."""
    view_of = {names.index(name): view for view, name in enumerate(model.names)}
    return [
        pair.replace(views=(view_of[pair.views[0]], view_of[pair.views[1]]))
        for pair in pairs
        if all(number in view_of for number in pair.views)
    ]


def verify_model(
    model: SparseModel, files: Sequence[str], pairs: Sequence[VerifiedPair], max_error_px: float
) -> tuple[float, dict[str, float]]:
    """Compute the agreement of a model with the verified matches of its photographs.

    Returns:
        The fraction of all matches that agree with the model's epipolar geometry, those of
        photographs that the model lacks counted as outliers; and, by name, views that contradict
        most matches of their strongest pairs, with the fraction that agrees.
    """
    inside = pairs_in(model, files, pairs)
    agrees = match_errors(model, inside) <= max_error_px
    counts = [pair.num_matches for pair in inside]
    agreeing = {
        pair.views: (pair.num_matches, float(inlier.double().mean()))
        for pair, inlier in zip(inside, torch.split(agrees, counts), strict=True)
    }
    misplaced = {}
    for view, name in enumerate(model.names):
        counted = [agreeing[pair] for pair in agreeing if view in pair]
        fraction = _agreeing_fraction(sorted(counted, reverse=True)[:3])
        if fraction < _MIN_AGREEMENT:
            misplaced[name] = fraction
    total = sum(pair.num_matches for pair in pairs)
    compared = sum(count for count, _ in agreeing.values())
    return _agreeing_fraction(agreeing.values()) * compared / total if total else 0.0, misplaced


def _agreeing_fraction(pairs: Collection[tuple[int, float]]) -> float:
    total = sum(count for count, _ in pairs)
    return sum(count * fraction for count, fraction in pairs) / total if total else 1.0


def agreement(model: SparseModel, pair: VerifiedPair, max_error_px: float) -> float:
    """Return the fraction of a pair's matches that agree with the model's epipolar geometry."""
    return float((match_errors(model, [pair]) <= max_error_px).double().mean())
