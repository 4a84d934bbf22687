"""Features matched between pairs of photographs, and verified by an epipolar geometry."""

import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.progress import track
from pimper_torch.records import Record
from pimper_torch.sfm.binding import loaded, quiet
from pimper_torch.sfm.reconstruct_config import MIN_MATCHES, ReconstructConfig
from pimper_torch.sfm.workspace import Workspace

# Photographs a side of a tile of pairs. COLMAP prepares the search in a photograph once a tile;
# tiles tell how far matching has come. Of 66 photographs, tiles of 16 prepare 400 searches where
# tiles of 8 prepare 648.
_TILE = 16

# Photographs up to which a set is small: every pair is matched, and every point is looked for in
# every view. Beyond, work grows with their number, not its square; see docs/decisions.md.
MOST_PAIRED = 66

PhotographPair = tuple[int, int]
"""Numbers of two photographs, the lower one first."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class VerifiedPair(Record):
    """Matches of two photographs that one epipolar geometry explains."""

    views: PhotographPair
    first: Float[Tensor, "match 2"]
    second: Float[Tensor, "match 2"]

    @property
    def num_matches(self) -> int:
        """Number of matches."""
        return len(self.first)


def match_pairs(
    space: Workspace,
    pairs: Sequence[PhotographPair],
    settings: ReconstructConfig,
    fewest: int = MIN_MATCHES,
) -> None:
    """Match pairs of photographs that are not matched yet, and verify the matches.

    Args:
        fewest: Verified matches below which a pair does not count.
    """
    pycolmap = loaded()

    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    options.num_threads = settings.num_threads
    options.sift.max_ratio = settings.max_ratio
    verification = pycolmap.TwoViewGeometryOptions()
    verification.min_num_inliers = fewest
    verification.ransac.max_error = settings.max_error_px
    verification.ransac.random_seed = settings.seed
    pairing = pycolmap.ImportedPairingOptions()
    with quiet(), tempfile.TemporaryDirectory(dir=space.folder) as folder:
        pairing.match_list_path = Path(folder) / "pairs.txt"
        for some in track(list(tiles(pairs))):
            lines = (f"{space.files[first]} {space.files[second]}\n" for first, second in some)
            pairing.match_list_path.write_text("".join(lines), encoding="ascii")
            pycolmap.match_image_pairs(
                space.database, options, pairing, verification, pycolmap.Device.cpu
            )


def all_pairs(count: int) -> list[PhotographPair]:
    """List every pair of so many photographs."""
    return list(combinations(range(count), 2))


def tiles(pairs: Sequence[PhotographPair]) -> Iterator[list[PhotographPair]]:
    """Group pairs so that those of a group share few photographs; larger groups of fewer pairs.

    >>> [len(some) for some in tiles(all_pairs(20))]
    [120, 64, 6]
    """
    groups: dict[PhotographPair, list[PhotographPair]] = {}
    count = 1 + max((second for _, second in pairs), default=0)
    side = int(_TILE * max(1.0, math.comb(count, 2) / max(len(pairs), 1)) ** 0.5)
    for first, second in pairs:
        groups.setdefault((first // side, second // side), []).append((first, second))
    yield from (groups[key] for key in sorted(groups))


def strongest(
    counts: Mapping[PhotographPair, float], num_views: int, most: int
) -> list[PhotographPair]:
    """List, without repetition, the pairs with most matches of each photograph.

    Args:
        counts: Verified matches of each pair, or another weight.
    """
    chosen: set[PhotographPair] = set()
    for view in range(num_views):
        mine = [pair for pair in counts if view in pair]
        chosen.update(sorted(mine, key=lambda pair: (-counts[pair], pair))[:most])
    return sorted(chosen)


def verified_pairs(space: Workspace) -> list[VerifiedPair]:
    """Read the matches that were verified, pair by pair."""
    with quiet(), loaded().Database.open(space.database) as stored:
        number = photograph_numbers(stored, space)
        pixels = {
            image: torch.from_numpy(
                np.array(stored.read_keypoints(image))[:, :2].astype(np.float64)
            )
            for image in number
        }
        found = []
        for pair_id, geometry in zip(*stored.read_two_view_geometries(), strict=True):
            ends = loaded().pair_id_to_image_pair(pair_id)
            rows = torch.from_numpy(np.array(geometry.inlier_matches).astype(np.int64))
            rows = rows.reshape(-1, 2)
            if len(rows):
                first, second = (
                    (number[image], pixels[image][rows[:, side]]) for side, image in enumerate(ends)
                )
                low, high = sorted((first, second), key=lambda end: end[0])
                found.append(VerifiedPair(views=(low[0], high[0]), first=low[1], second=high[1]))
        return found


def photograph_numbers(
    stored: Any,  # noqa: ANN401 - pycolmap is untyped
    space: Workspace,
) -> dict[int, int]:
    """Return the number of the photograph behind each image of the database."""
    number = {file: index for index, file in enumerate(space.files)}
    return {image.image_id: number[image.name] for image in stored.read_all_images()}
