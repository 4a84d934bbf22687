"""Whether known cameras and photographs belong together, by matches between photographs.

Matches that an epipolar geometry of their own explains are found without the cameras. With the
right cameras most of them lie on these cameras' epipolar lines and before both; with wrong ones a
few do by chance. Candidates are the cameras turned as the files store photographs, and of
photographs that were cropped.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.ground.geometry.lens_models import pinhole_of
from pimper_torch.method.sfm.conventions import resized_pictures
from pimper_torch.method.sfm.conventions.choice import surely_better
from pimper_torch.method.sfm.epipolar import explained, match_errors, pinholes_of, undistorted_pairs
from pimper_torch.method.sfm.matching import VerifiedPair
from pimper_torch.method.sfm.model import SparseModel
from pimper_torch.method.sfm.reconstruct_config import MIN_MATCHES
from pimper_torch.runtime.errors import InputError, caution

# Fraction of the matches that right cameras explain: 0.97 to 1.00 at 2 px in five scenes (the
# skull, three rendered ones of 240 to 400 px, a ball in closed form). Below the first, cameras are
# refused; from the second on, they are believed, and so is a crop.
_MIN_AGREEMENT, _RIGHT = 0.5, 0.95


def choose_way(
    ways: resized_pictures.Ways, verified: Sequence[VerifiedPair], max_error_px: float, where: str
) -> SparseModel:
    """Choose the cameras that explain most matches.

    Args:
        verified: Matches that an epipolar geometry of their own explains.
        max_error_px: Distance from epipolar lines that is not told from a larger one.

    Raises:
        InputError: None explains enough, or nothing tells which crop does.
    """
    given = ways.plain[0] if ways.plain else None
    if len(ways.plain) > 1:
        given = _choose_turns(ways.plain, verified, max_error_px, where)
    if ways.cropped:
        given = _find_crop(given, ways, verified, max_error_px, where) or given
    assert given is not None, "a crop is found, or refused, where no resize is possible"
    _require_agreement(given, verified, max_error_px, where)
    return given


def _choose_turns(
    models: Sequence[SparseModel], verified: Sequence[VerifiedPair], max_error_px: float, where: str
) -> SparseModel:
    """Choose between cameras of photographs as they stand, and as their files store them."""
    scores = [_explained_fraction(model, verified, max_error_px) for model in models]
    best = scores.index(max(scores))
    if sum(pair.num_matches for pair in verified) < MIN_MATCHES:
        resized_pictures.tell_open_turns(where, "matches")
    elif best:
        resized_pictures.tell_turned(where, "what their matches show")
    return models[best]


def _find_crop(
    plain: SparseModel | None,
    ways: resized_pictures.Ways,
    verified: Sequence[VerifiedPair],
    max_error_px: float,
    where: str,
) -> SparseModel | None:
    """Find where photographs were cut out of the pictures that cameras are of, by their matches.

    From the best of the usual crops on, all of them are shifted together until matches lie nearest
    to the epipolar lines.

    Args:
        plain: Cameras of resized photographs, if such a shape is possible: the plain explanation.

    Returns:
        ``None`` where a resize explains the matches as well.
    """
    crops, changed = ways.cropped, ways.changed
    strongest = sorted(verified, key=lambda pair: -pair.num_matches)[:200]  # a second

    def errors(model: SparseModel) -> Float[Tensor, " match"]:
        return match_errors(model, strongest).clamp_max(max_error_px)

    def shifted(shift: Float[Tensor, "2"]) -> SparseModel:
        return resized_pictures.cut(usual, changed, None, shift)

    usual = min(crops, key=lambda model: float(errors(model).mean()))
    middle, corner = (pinhole_of(one.lenses[changed[0]])[:2, 2] for one in (crops[0], crops[-1]))
    room = 2 * (middle - corner).abs()
    shift, step = torch.zeros_like(room), float(room.max()) / 4
    while step >= 0.5:
        for _ in range(12):
            ring = torch.cat([torch.zeros(1, 2).to(shift), step * resized_pictures.around(shift)])
            shifts = torch.minimum(torch.maximum(shift + ring, -room), room)
            means = torch.stack([errors(shifted(one)).mean() for one in shifts])
            nearest = shifts[means.argmin()]
            if torch.equal(nearest, shift):
                break
            shift = nearest
        step /= 2
    if not surely_better(errors(usual), errors(shifted(shift))):
        shift = torch.zeros_like(shift)
    crop = shifted(shift)
    best = errors(crop)
    if plain is not None and not surely_better(errors(plain), best):
        return None
    beside = [errors(shifted(shift + 8 * one)) for one in resized_pictures.around(shift)]
    sharp = all(surely_better(one, best) for one in beside)
    if _explained_fraction(crop, verified, max_error_px) <= _RIGHT or not sharp:
        raise InputError(
            f"{resized_pictures.of_another_size(where, crop, changed)}, and what their matches "
            "show fits a crop better than a resize, but does not tell which crop. Give the "
            "photographs that it was made from, resized if you like, but not cropped."
        )
    resized_pictures.tell_crop(where, crop, changed, "what their matches show")
    return crop


def _require_agreement(
    model: SparseModel, verified: Sequence[VerifiedPair], max_error_px: float, where: str
) -> None:
    """Refuse cameras that explain too little, and warn of doubtful ones."""
    total = sum(pair.num_matches for pair in verified)
    given = _explained_fraction(model, verified, max_error_px)
    if total < 30 or given > _RIGHT:
        return
    found = (
        f"{given:.0%} of {total} matches in {len(verified)} pairs of photographs lie within "
        f"{max_error_px:g} px of the cameras' epipolar lines and before both cameras"
    )
    advice = (
        "Needed are cam_from_world, not its inverse, with camera axes x right, y down, z forward, "
        "and the names, order, sizes and lens of these photographs; or leave the cameras out to "
        "find them by structure from motion."
    )
    if given < _MIN_AGREEMENT:
        raise InputError(
            f"{where}: these cameras and the photographs do not belong together: {found}; needed: "
            f"at least {_MIN_AGREEMENT:.0%}. {advice}"
        )
    if given < 0.9:  # cameras of a mirrored relief explain up to 0.83 along an arc
        caution(f"{where}: its cameras are doubtful: {found}. {advice}", stacklevel=5)


def _explained_fraction(
    model: SparseModel, verified: Sequence[VerifiedPair], max_error_px: float
) -> float:
    pairs, cameras = undistorted_pairs(model, verified), pinholes_of(model)
    right = sum(int(explained(cameras, pair, max_error_px).sum()) for pair in pairs)
    return right / max(sum(pair.num_matches for pair in pairs), 1)
