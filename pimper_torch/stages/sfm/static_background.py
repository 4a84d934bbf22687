"""Features of the static background behind an object that turns in front of a fixed camera.

If camera and background do not move and the object turns, such as on a turntable, two motions are
in the photographs: the object's, and none. A match with both features at the same pixel is
*static*. A rigid scene also has static matches: points at infinity seen by a camera that only
shifts, or points near the axis of a turn. But there one epipolar geometry explains them together
with the moving matches. No geometry explains a static background together with a turning object.

A background that shifts, because the tripod was touched, is not detected. A model registered on it
is unreliable, see :mod:`pimper_torch.stages.sfm.diagnose`.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.geometry.colmap_library import loaded, quiet
from pimper_torch.records import Record
from pimper_torch.records.shapes import Matrix3
from pimper_torch.runtime.progress import track
from pimper_torch.stages.sfm import matching
from pimper_torch.stages.sfm.epipolar import violating
from pimper_torch.stages.sfm.matching import Keypoints, PhotographPair, Rows
from pimper_torch.stages.sfm.reconstruct_config import MIN_MATCHES, ReconstructConfig

# Least violating fraction of a detected background. Simulated with 0.2 px of noise: 0.00 in rigid
# scenes; with a background 0.2 if the camera is 2 degrees above the table, 0.5 from 10, 0.8 from
# 25.
_CONTRADICTION = 0.1
# Longest static match. In 24 rendered photographs of 640x480, 99 % of the matches of a static
# background are shorter, and 0.4 % of those of a turning mug.
_STATIC_PX = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class StaticBackground(Record):
    """Static background of photographs.

    Attributes:
        features: True for features of a static background, one tensor per photograph.
        static_fraction: Fraction of all matches with both features at the same pixel.
        moving_pairs: Number of pairs with static matches in which others fit one epipolar geometry.
        violating_fraction: Fraction of the moving matches of these pairs that no geometry explains
            together with the static ones; 0 without such pairs.
    """

    features: tuple[Bool[Tensor, " _"], ...]
    static_fraction: float
    moving_pairs: int
    violating_fraction: float

    @property
    def detected(self) -> bool:
        """True if the background is static while something else moves."""
        return self.violating_fraction > _CONTRADICTION

    @property
    def maps(self) -> list[Matrix3]:
        """Maps from the pixels of each photograph to the frame in which the background is static.

        The identity; NaN for a photograph that shows too little of it. Empty without a background.
        """
        identity = torch.eye(3).double()
        scales = [1 if int(x.sum()) >= MIN_MATCHES else torch.nan for x in self.features]
        return [identity * scale for scale in scales] if self.detected else []

    @property
    def nothing_moves(self) -> bool:
        """True if most matches are static, and no pair has enough moving ones."""
        return self.static_fraction > 0.5 and self.moving_pairs == 0


def remove_static_features(database: Path, settings: ReconstructConfig) -> StaticBackground:
    """Detect a static background, and remove its features and matches.

    Pairs that were verified on the background are verified again.

    Args:
        database: With features, matches and verified pairs. Unchanged without a static background.
    """
    with quiet(), loaded().Database.open(database) as opened:
        verifier, limit = matching.read_verifier(opened, settings), settings.max_error_px
        background = find_static_background(verifier.keypoints, verifier.pairs, verifier, limit)
        if background.detected:
            _keep_moving(opened, verifier, background)
    return background


def find_static_background(
    keypoints: Keypoints, pairs: matching.Matches, verify: matching.Verify, max_error_px: float
) -> StaticBackground:
    """Separate features of the static background from those of the moving object.

    Each pair with static matches, and with moving ones that fit one epipolar geometry, votes:
    static matches for static features, moving ones for moving features. The majority decides,
    unless one geometry explains static and moving matches together: then the scene is rigid and no
    feature is static. Pairs of identical photographs have no moving matches and do not vote.
    """
    lengths = {pair: _lengths_px(keypoints, pair, rows) for pair, rows in pairs.items()}
    static = {pair: rows[lengths[pair] < _STATIC_PX] for pair, rows in pairs.items()}
    # Less exactly detected static features do not count as moving.
    moving = {pair: rows[lengths[pair] >= 4 * _STATIC_PX] for pair, rows in pairs.items()}
    smaller = {pair: min(len(static[pair]), len(moving[pair])) for pair in pairs}
    order = sorted(pairs, key=smaller.__getitem__, reverse=True)
    informative = [pair for pair in order if smaller[pair] >= MIN_MATCHES]
    votes = [torch.zeros(len(x), dtype=torch.long) for x in keypoints]  # for static
    num_moving = num_violating = moving_pairs = 0
    # The first pairs, with most matches of both kinds, must contradict one geometry. Otherwise no
    # more are verified.
    for start in track(range(0, len(informative), 24)):
        group = informative[start : start + 24]
        for pair, rows in verify({pair: moving[pair] for pair in group}).items():
            if len(rows) < MIN_MATCHES:
                continue
            far = violating(keypoints, pair, static[pair], rows, max_error_px)
            moving_pairs += 1
            num_moving += len(rows)
            num_violating += int(far[1].sum())
            matching.add_votes(votes, pair, static[pair], torch.ones_like(static[pair]))
            matching.add_votes(votes, pair, rows, -torch.ones_like(rows))
        if num_moving and num_violating <= _CONTRADICTION * num_moving:
            break
    fraction = num_violating / max(num_moving, 1)
    return StaticBackground(
        features=tuple((vote > 0) & (fraction > _CONTRADICTION) for vote in votes),
        static_fraction=sum(map(len, static.values())) / max(sum(map(len, pairs.values())), 1),
        moving_pairs=moving_pairs,
        violating_fraction=fraction,
    )


def moving_matches(
    keypoints: Keypoints, pair: PhotographPair, rows: Rows, background: StaticBackground
) -> Bool[Tensor, " match"]:
    """Return the matches that are not static and have no static feature."""
    touched = background.features[pair[0]][rows[:, 0]] | background.features[pair[1]][rows[:, 1]]
    return ~touched & (_lengths_px(keypoints, pair, rows) >= _STATIC_PX)


def _lengths_px(keypoints: Keypoints, pair: PhotographPair, rows: Rows) -> Float[Tensor, " match"]:
    first, second = matching.match_ends(keypoints, pair, rows)
    return (first - second).norm(dim=-1)


def _keep_moving(
    database: Any,  # noqa: ANN401 - pycolmap is untyped
    verifier: matching.Verifier,
    background: StaticBackground,
) -> None:
    descriptors = [database.read_descriptors(image) for image in verifier.ids]
    database.clear_descriptors()
    for image, static, old in zip(verifier.ids, background.features, descriptors, strict=True):
        moves = (~static).numpy()
        database.update_keypoints(image, np.array(database.read_keypoints(image))[moves])
        kept = loaded().FeatureDescriptors(old.type, old.data[moves])
        database.write_descriptors(image, kept)
    number = [torch.cumsum(~static, dim=0) - 1 for static in background.features]

    def moving(pair: PhotographPair, rows: Rows) -> np.ndarray:
        rows = rows[moving_matches(verifier.keypoints, pair, rows, background)]
        ends = [number[view][rows[:, side]] for side, view in enumerate(pair)]
        return torch.stack(ends, dim=1).numpy().astype(np.uint32)

    geometries = matching.read_geometries(database, verifier.ids) | verifier.geometries
    database.clear_matches()
    database.clear_two_view_geometries()
    for pair, rows in verifier.pairs.items():
        ids = verifier.ids[pair[0]], verifier.ids[pair[1]]
        database.write_matches(*ids, moving(pair, rows))
        if geometry := geometries.get(pair):
            inliers = moving(pair, matching.indices(geometry.inlier_matches))
            if len(inliers) >= MIN_MATCHES:
                geometry.inlier_matches = inliers
                database.write_two_view_geometry(*ids, geometry)
