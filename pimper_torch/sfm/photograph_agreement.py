"""Whether known cameras and photographs belong together, and under which convention they would.

Matches that an epipolar geometry of their own explains are found without the cameras. With the
right cameras most of them lie on these cameras' epipolar lines and before both; with wrong ones a
few do by chance. Cameras of another convention are put right in every usual way, and tried again.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool
from torch import Tensor

from pimper_torch.camera_files.conventions import camera_mistakes, far_better
from pimper_torch.errors import InputError
from pimper_torch.geometry.pixels import homogeneous
from pimper_torch.records import Cameras
from pimper_torch.sfm.agreement import epipolar_geometry, pinholes_of, undistorted_pairs
from pimper_torch.sfm.matching import VerifiedPair
from pimper_torch.sfm.model import SparseModel
from pimper_torch.sfm.static_background import sampson_errors

# Fraction of the matches that right cameras explain: 0.97 to 1.00 at 2 px in five scenes (the
# skull, three rendered ones of 240 to 400 px, a ball in closed form).
MIN_AGREEMENT = 0.5
# Those of another convention explain up to 0.83 of them, where cameras stand on an arc and look at
# one point: turned about their axes, they are those of a mirrored relief. One that leaves out less
# than this fraction of what the given cameras leave out, and a twentieth of all less, is right.
_LEFT, _MARGIN = 0.6, 0.05
# Matches below which nothing is said: a choice.
_FEWEST = 30


def explained_fraction(
    model: SparseModel, verified: Sequence[VerifiedPair], max_error_px: float
) -> float:
    """Return the fraction of matches that the cameras of a model explain."""
    return _fraction(undistorted_pairs(model, verified), pinholes_of(model), max_error_px)


def _fraction(pairs: Sequence[VerifiedPair], cameras: Cameras, max_error_px: float) -> float:
    """Return the fraction of undistorted matches that cameras explain."""
    right = sum(int(explained(cameras, pair, max_error_px).sum()) for pair in pairs)
    return right / max(sum(pair.num_matches for pair in pairs), 1)


def explained(cameras: Cameras, pair: VerifiedPair, max_error_px: float) -> Bool[Tensor, " match"]:
    """Find the matches on each other's epipolar lines whose point is before both cameras.

    Args:
        cameras: Pinholes; axes may be mirrored.
        pair: Its numbers are those of views; pixels of pinholes.
        max_error_px: Sampson's distance.
    """
    one, other = pair.views
    K, poses = cameras.intrinsics, cameras.cam_from_world
    geometry = epipolar_geometry(cameras, pair.views)
    near = sampson_errors(geometry, pair.first, pair.second) <= max_error_px
    between = poses[other] @ torch.linalg.inv(poses[one])
    rays = homogeneous(pair.first) @ torch.linalg.inv(K[one]).mT @ between[:3, :3].mT
    back = homogeneous(pair.second) @ torch.linalg.inv(K[other]).mT
    # Where x rays + t meets y back, as well as they do: signs of x and y tell.
    shift = between[:3, 3].expand_as(rays)
    normal = torch.linalg.cross(rays, back)
    ahead = (torch.linalg.cross(back, shift) * normal).sum(dim=1) > 0
    ahead_there = (torch.linalg.cross(rays, shift) * normal).sum(dim=1) > 0
    return near & ahead & ahead_there


def require_agreement(
    model: SparseModel, verified: Sequence[VerifiedPair], max_error_px: float, where: str
) -> None:
    """Refuse cameras that explain too little of what photographs show in common.

    Args:
        verified: Matches that an epipolar geometry of their own explains.

    Raises:
        InputError: Names the convention that would fit, if one of the usual does.
    """
    pairs, cameras = undistorted_pairs(model, verified), pinholes_of(model)
    total = sum(pair.num_matches for pair in pairs)
    given = _fraction(pairs, cameras, max_error_px)
    if total < _FEWEST or given > 1 - _MARGIN:
        return
    mistakes = camera_mistakes(cameras)
    scores = [_fraction(pairs, one.undo(cameras), max_error_px) for one in mistakes]
    best = far_better(given, scores, _LEFT, _MARGIN)
    if given >= MIN_AGREEMENT and best is None:
        return
    advice = _NOTHING_FITS
    if best is not None:
        advice = (
            f"{scores[best]:.0%} do if {mistakes[best].meaning}. Put them right: "
            f"{mistakes[best].remedy}. Needed here: cam_from_world, camera axes x right, y down, z "
            "forward."
        )
    raise InputError(
        f"{where}: these cameras and the photographs do not belong together: {given:.0%} of "
        f"{total} matches in {len(pairs)} pairs of photographs lie within "
        f"{max_error_px:g} px of the cameras' epipolar lines and before both cameras; needed: at "
        f"least {MIN_AGREEMENT:.0%}, and more than under other conventions. "
        f"{advice}"
    )


_NOTHING_FITS = (
    "No usual mistake of conventions explains it. Look whether names, order, sizes and lens are "
    "those of these photographs, or leave the cameras out to find them by structure from motion."
)
