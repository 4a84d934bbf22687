r"""Features of a room that is at rest in front of the camera while the object turns.

Where camera and room do not move and the object turns, as on a turntable, two motions fit the
photographs: the object's, and none at all. A match whose features lie at the same pixel is *still*.
A rigid scene has still matches, too: points at infinity in front of a camera that only shifts, or
points near the axis of a turn. But there one epipolar geometry explains them together with the
matches that move. No geometry explains a room at rest together with an object that turns.

A room that shifts, because the tripod was touched, is not found. A model that was registered on it
is doubted, see :mod:`pimper_torch.method.sfm.diagnose`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from pimper_torch.ground.geometry.colmap_library import loaded, quiet
from pimper_torch.ground.shapes import Matrix3
from pimper_torch.method.sfm import matching
from pimper_torch.method.sfm.epipolar import sampson_errors, shared_geometry
from pimper_torch.method.sfm.matching import Keypoints, PhotographPair, Rows
from pimper_torch.method.sfm.reconstruct_config import MIN_MATCHES, ReconstructConfig
from pimper_torch.records import Record
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.progress import track

# Of the moving matches. Simulated with 0.2 px of noise: 0.00 in rigid scenes; before a room at
# rest 0.2 with the camera 2 degrees over the table's plane, 0.5 from 10, 0.8 from 25.
_CONTRADICTION = 0.1
# Longest still match. Of 24 rendered photographs of 640x480, 99 % of the matches of a room at rest
# are shorter, and 0.4 % of those of a turning mug.
_STATIC_PX = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class StaticBackground(Record):
    """Static background of photographs.

    Attributes:
        features: True for those of a room at rest, one tensor a photograph.
        still_fraction: Of all matches, those whose features lie at the same pixel.
        moving_pairs: Pairs with still matches in which others move by one epipolar geometry.
        violating_fraction: Of the moving matches in those, the ones that no geometry explains
            together with the still ones; 0 without such pairs.
    """

    features: tuple[Bool[Tensor, " _"], ...]
    static_fraction: float
    moving_pairs: int
    violating_fraction: float

    @property
    def detected(self) -> bool:
        """True where something is at rest while something else moves."""
        return self.violating_fraction > _CONTRADICTION

    @property
    def maps(self) -> list[Matrix3]:
        """Maps from the pixels of each photograph to those where the room is at rest.

        The identity; NaN where a photograph shows too little of it. None without a room.
        """
        identity = torch.eye(3).double()
        enough = [int(one.sum()) >= MIN_MATCHES for one in self.features]
        return (
            [identity if one else identity * torch.nan for one in enough] if self.detected else []
        )

    @property
    def nothing_moves(self) -> bool:
        """True where most matches are still, and nowhere do enough others move."""
        return self.static_fraction > 0.5 and self.moving_pairs == 0


def remove_static_features(database: Path, settings: ReconstructConfig) -> StaticBackground:
    """Find what is at rest while something else moves, and keep features and matches of the latter.

    Pairs that were verified on what is at rest are verified anew.

    Args:
        database: With features, matches and verified pairs. Where nothing is at rest it stays
            as it is.
    """
    with quiet(), loaded().Database.open(database) as stored:
        matched = matching.read_matched(stored)
        verifier = matching.Verifier(matched=matched, settings=settings)
        limit = settings.max_error_px
        background = find_static_background(matched.keypoints, matched.pairs, verifier, limit)
        if background.detected:
            geometries = matching.read_geometries(stored, matched.ids) | verifier.geometries
            _keep_moving(stored, matched, background, geometries)
    return background


def log_static_features(background: StaticBackground) -> tuple[int, int]:
    """Enter in the ledger how many features rest with a room; return their and all numbers."""
    static = sum(int(one.sum()) for one in background.features)
    total = sum(map(len, background.features))
    leave_out("sfm.static_background", static, total=total)
    return static, total


def find_static_background(
    keypoints: Keypoints, pairs: matching.Matches, verify: matching.Verify, max_error_px: float
) -> StaticBackground:
    """Separate features of the static background from those of the moving object.

    Each pair that has both still matches and moving ones that one epipolar geometry explains
    votes: a still match says that its features rest, a moving one that they move. Features rest
    where more says so, unless one geometry explains still and moving matches together: then
    the scene is rigid and all its features stay. Pairs of identical photographs have no moving
    matches and do not vote.
    """
    votes = [torch.zeros(len(one), dtype=torch.long) for one in keypoints]  # for rest
    num_moving = num_violating = moving_pairs = 0
    split = {pair: _split(keypoints, pair, rows) for pair, rows in pairs.items()}
    shown = {pair: min(map(len, both)) for pair, both in split.items()}
    order = sorted(split, key=shown.__getitem__, reverse=True)
    informative = [pair for pair in order if shown[pair] >= MIN_MATCHES]
    # The first pairs, which show most of both, must contradict one geometry: else no more are
    # verified.
    for start in track(range(0, len(informative), 24)):
        group = informative[start : start + 24]
        for pair, moving in verify({pair: split[pair][1] for pair in group}).items():
            if len(moving) < MIN_MATCHES:
                continue
            static_rows = split[pair][0]
            static, ends = (
                matching.pixels_of(keypoints, pair, some) for some in (static_rows, moving)
            )
            geometry = shared_geometry(static, ends, max_error_px)
            moving_pairs += 1
            num_moving += len(moving)
            num_violating += int((sampson_errors(geometry, *ends) > max_error_px).sum())
            matching.add_votes(votes, pair, static_rows, torch.ones_like(static_rows))
            matching.add_votes(votes, pair, moving, -torch.ones_like(moving))
        if num_moving and num_violating <= _CONTRADICTION * num_moving:
            break
    num_static = sum(len(static) for static, _ in split.values())
    fraction = num_violating / max(num_moving, 1)
    return StaticBackground(
        features=tuple((one > 0) & (fraction > _CONTRADICTION) for one in votes),
        static_fraction=num_static / max(sum(map(len, pairs.values())), 1),
        moving_pairs=moving_pairs,
        violating_fraction=fraction,
    )


def moving_matches(
    keypoints: Keypoints, pair: PhotographPair, rows: Rows, background: StaticBackground
) -> Bool[Tensor, " match"]:
    """Find matches that are neither still nor of a feature at rest."""
    touched = background.features[pair[0]][rows[:, 0]] | background.features[pair[1]][rows[:, 1]]
    first, second = matching.pixels_of(keypoints, pair, rows)
    return ~touched & ((first - second).norm(dim=-1) >= _STATIC_PX)


def _split(keypoints: Keypoints, pair: PhotographPair, rows: Rows) -> tuple[Rows, Rows]:
    """Return a pair's still matches, and those that clearly move."""
    first, second = matching.pixels_of(keypoints, pair, rows)
    length = (first - second).norm(dim=-1)
    # Features at rest that were found less exactly do not show motion.
    return rows[length < _STATIC_PX], rows[length >= 4 * _STATIC_PX]


def _keep_moving(
    stored: Any,  # noqa: ANN401 - pycolmap is untyped
    matched: matching.Matched,
    background: StaticBackground,
    geometries: Mapping[PhotographPair, Any],
) -> None:
    described = [stored.read_descriptors(image) for image in matched.ids]
    stored.clear_descriptors()
    for image, static, one in zip(matched.ids, background.features, described, strict=True):
        moves = (~static).numpy()
        stored.update_keypoints(image, np.array(stored.read_keypoints(image))[moves])
        kept = loaded().FeatureDescriptors(one.type, one.data[moves])
        stored.write_descriptors(image, kept)
    number = [torch.cumsum(~static, dim=0) - 1 for static in background.features]

    def moving(pair: PhotographPair, rows: Rows) -> np.ndarray:
        rows = rows[moving_matches(matched.keypoints, pair, rows, background)]
        ends = [number[view][rows[:, side]] for side, view in enumerate(pair)]
        return torch.stack(ends, dim=1).numpy().astype(np.uint32)

    stored.clear_matches()
    stored.clear_two_view_geometries()
    for pair, rows in matched.pairs.items():
        ids = matched.ids[pair[0]], matched.ids[pair[1]]
        stored.write_matches(*ids, moving(pair, rows))
        if geometry := geometries.get(pair):
            inliers = moving(pair, matching.indices(geometry.inlier_matches))
            if len(inliers) >= MIN_MATCHES:
                geometry.inlier_matches = inliers
                stored.write_two_view_geometry(*ids, geometry)
