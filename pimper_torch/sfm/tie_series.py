"""Tie series of photographs between which the object was moved by the object, in COLMAP's database.

See :mod:`pimper_torch.sfm.moved_object`.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from pimper_torch.sfm.binding import loaded, quiet
from pimper_torch.sfm.leave_out import (
    Matched,
    among,
    indices,
    read_geometries,
    read_matched,
    verified_again,
)
from pimper_torch.sfm.matching import PhotographPair, VerifiedPair
from pimper_torch.sfm.moved_object import MovedObject, Rows, find_moved_object
from pimper_torch.sfm.reconstruct_config import MIN_MATCHES, ReconstructConfig
from pimper_torch.sfm.static_background import Pair


def tie_series(
    database: Path, settings: ReconstructConfig
) -> tuple[MovedObject, tuple[VerifiedPair, ...]]:
    """Find series between which the object was moved, and keep between them what is the object's.

    Args:
        database: With features, matches and verified pairs. Where nothing was moved it stays as it
            is.

    Returns:
        The series, and the matches of the surroundings, within series and between.
    """
    with quiet(), loaded().Database.open(database) as stored:
        matched = read_matched(stored)
        number = {image: index for index, image in enumerate(matched.ids)}
        geometries = {
            (number[first], number[second]): geometry
            for (first, second), geometry in read_geometries(stored).items()
            if len(geometry.inlier_matches) >= MIN_MATCHES
        }
        verified = {pair: indices(one.inlier_matches) for pair, one in geometries.items()}
        outside = {
            (pair.first, pair.second): pair.matches[
                ~among(pair.matches, verified[pair.first, pair.second])
            ]
            for pair in matched.pairs
            if (pair.first, pair.second) in verified
        }
        seconds: dict[PhotographPair, Any] = {}

        def verify(some: Mapping[PhotographPair, Rows]) -> dict[PhotographPair, Rows]:
            pairs = [Pair(first=pair[0], second=pair[1], matches=some[pair]) for pair in some]
            seconds.update(zip(some, verified_again(matched, pairs, settings), strict=True))
            return {pair: indices(seconds[pair].inlier_matches) for pair in some}

        found = find_moved_object(
            matched.keypoints,
            _sizes(matched),
            verified,
            {pair: rows for pair, rows in outside.items() if pair in verified},
            verify,
            max_error_px=settings.max_error_px,
            fewest=MIN_MATCHES,
        )
        for pair, rows in found.tying.items():
            if not torch.equal(rows, verified[pair]):
                ids = matched.ids[pair[0]], matched.ids[pair[1]]
                stored.update_two_view_geometry(*ids, seconds[pair])
        for pair in found.dropped:
            stored.delete_two_view_geometry(matched.ids[pair[0]], matched.ids[pair[1]])
    pixels = [one.double() for one in matched.keypoints]
    around = tuple(
        VerifiedPair(
            views=pair, first=pixels[pair[0]][rows[:, 0]], second=pixels[pair[1]][rows[:, 1]]
        )
        for pair, rows in found.around.items()
        if len(rows)
    )
    return found, around


def _sizes(matched: Matched) -> torch.Tensor:
    return torch.tensor([(one.width, one.height) for one in matched.cameras]).float()
