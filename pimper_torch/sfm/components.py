"""Which part of a split model to go on with."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool
from torch import Tensor

from pimper_torch.errors import ReconstructionError, some
from pimper_torch.geometry.projection import triangulation_angles
from pimper_torch.geometry.rigid import invert_rigid
from pimper_torch.sfm.model import SparseModel
from pimper_torch.sfm.static_background import StaticBackground

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
    """Count the views that see enough points under a triangulation angle that tells depth.

    Args:
        fewest: Points that a view must see whose widest angle between rays is 4 degrees or more.
    """
    seen = model.observed[wide_points(model)].sum(dim=0)
    return int((seen >= fewest).sum())


def wide_points(model: SparseModel) -> Bool[Tensor, " point"]:
    """Find points whose widest angle between rays is 4 degrees or more."""
    centers = invert_rigid(model.cam_from_world)[:, :3, 3]
    angles = triangulation_angles(model.points_world, model.observed, centers)
    return torch.rad2deg(angles) >= MIN_ANGLE_DEG


def require_motion(rest: StaticBackground, num_views: int) -> None:
    """Refuse photographs in which nothing moves."""
    if rest.nothing_moves:
        raise ReconstructionError(
            f"Nothing moves in {num_views} photographs: {rest.still_fraction:.0%} of the matches "
            "lie at the same pixel, and in no pair do enough others agree on a motion. Camera and "
            f"background were at rest, and an object that turned has too little texture. {MOVE}"
        )


def choose_component(
    components: Sequence[tuple[str, ...]],
    spread: Sequence[int],
    names: Sequence[str],
    min_fraction: float,
) -> int:
    """Choose the component to keep: the one with most views that see depth.

    Args:
        components: Names of the views in each component; they may overlap.
        spread: How many views of each see enough points under real triangulation angles, see
            :func:`count_spread_views`.
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
    kept = components[largest] if components else ()
    if len(kept) < FEWEST_VIEWS:
        missing = [name for name in names if name not in kept]
        raise ReconstructionError(
            f"Structure from motion registered {len(kept)} of {len(names)} photographs; at least "
            f"{FEWEST_VIEWS} are needed. Not registered: {some(missing, most=20)}. {ADVICE}"
        )
    if spread[largest] < FEWEST_VIEWS:
        raise ReconstructionError(
            f"Structure from motion registered {len(kept)} of {len(names)} photographs, but only "
            f"{spread[largest]} of them see enough points under triangulation angles of "
            f"{MIN_ANGLE_DEG:.0f} degrees or more; at least {FEWEST_VIEWS} are needed. The "
            "cameras were found in nearly one place: they stood still, or they were registered on "
            f"a background at rest. {MOVE}"
        )
    rivals = [
        part
        for part, depth in zip(components, spread, strict=True)
        if depth >= FEWEST_VIEWS and len(set(part) - set(kept)) >= 3
    ]
    if rivals and len(kept) < min_fraction * len(names):
        parts = "; ".join(
            f"{len(part)} photographs ({some(part, most=12)})" for part in (kept, *rivals)
        )
        raise ReconstructionError(
            f"Structure from motion split {len(names)} photographs into {1 + len(rivals)} models "
            f"that nothing ties together: {parts}. One model with at least {min_fraction:.0%} of "
            f"the photographs is needed. {ADVICE} Where the object was turned over between the "
            f"groups, its own features must tie them. {JOINING} Or reconstruct one of the groups "
            "on its own."
        )
    return largest
