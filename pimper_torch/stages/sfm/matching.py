"""Features matched between pairs of photographs, and verified by epipolar geometry."""

import math
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.geometry.colmap_library import loaded, quiet
from pimper_torch.records import Record
from pimper_torch.records.shapes import Matrix3
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.runtime.progress import track
from pimper_torch.stages.sfm.features import Workspace, image_ids
from pimper_torch.stages.sfm.reconstruct_config import MIN_MATCHES, ReconstructConfig

# Largest number of photographs of which every pair is matched, and every point is searched for in
# every view. Beyond, work grows with their number, not its square; see docs/decisions.md.
MOST_PAIRED = 66

PhotographPair = tuple[int, int]
"""Numbers of two photographs, the lower one first."""
Keypoints = Sequence[Float[Tensor, "_ 2"]]
"""Pixels of the features of each photograph."""
Rows = Int[Tensor, "match 2"]
"""Indices of matched features in the first and second photograph, one match per row."""
Matches = Mapping[PhotographPair, Rows]
Verify = Callable[[Matches], Matches]
"""Returns each pair's inliers of one epipolar geometry."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class VerifiedPair(Record):
    """Matches of two photographs that are inliers of one epipolar geometry."""

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
    """Match pairs of photographs that are not matched yet, and verify the matches."""
    pycolmap = loaded()

    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    options.num_threads = settings.num_threads
    options.sift.max_ratio = settings.max_ratio
    verification = _verification(settings, fewest)
    pairing = pycolmap.ImportedPairingOptions()
    with quiet(), tempfile.TemporaryDirectory(dir=space.folder) as folder:
        pairing.match_list_path = Path(folder) / "pairs.txt"
        for tile in track(list(tiles(pairs))):
            lines = (f"{space.files[first]} {space.files[second]}\n" for first, second in tile)
            pairing.match_list_path.write_text("".join(lines), encoding="ascii")
            pycolmap.match_image_pairs(
                space.database, options, pairing, verification, pycolmap.Device.cpu
            )


def _verification(settings: ReconstructConfig, fewest: int) -> Any:  # noqa: ANN401 - pycolmap is untyped
    """Return COLMAP's options of epipolar geometry."""
    options = loaded().TwoViewGeometryOptions()
    options.min_num_inliers = fewest
    options.ransac.max_error = settings.max_error_px
    options.ransac.random_seed = settings.seed
    return options


def all_pairs(count: int) -> list[PhotographPair]:
    """List all pairs of ``count`` photographs."""
    return list(combinations(range(count), 2))


def tiles(pairs: Sequence[PhotographPair]) -> Iterator[list[PhotographPair]]:
    """Group pairs so that each group has few different photographs; fewer pairs form larger groups.

    >>> [len(tile) for tile in tiles(all_pairs(20))]
    [120, 64, 6]
    """
    groups: dict[PhotographPair, list[PhotographPair]] = {}
    count = 1 + max((second for _, second in pairs), default=0)
    # COLMAP prepares the search in a photograph once per tile: of 66, tiles of 16 prepare 400
    # searches, tiles of 8 prepare 648.
    side = int(16 * max(1.0, math.comb(count, 2) / max(len(pairs), 1)) ** 0.5)
    for first, second in pairs:
        groups.setdefault((first // side, second // side), []).append((first, second))
    yield from (groups[key] for key in sorted(groups))


def strongest(
    counts: Mapping[PhotographPair, float], num_views: int, most: int
) -> list[PhotographPair]:
    """List, without repetition, the pairs with most matches of each photograph."""
    chosen: set[PhotographPair] = set()
    for view in range(num_views):
        candidates = [pair for pair in counts if view in pair]
        chosen.update(sorted(candidates, key=lambda pair: (-counts[pair], pair))[:most])
    return sorted(chosen)


def verified_pairs(space: Workspace) -> list[VerifiedPair]:
    """Read the verified matches of each pair."""
    with quiet(), loaded().Database.open(space.database) as database:
        images = image_ids(database, space)
        pixels = [read_pixels(database, image) for image in images]
        return pairs_of(pixels, read_verified(database, images))


def pairs_of(keypoints: Keypoints, matches: Matches) -> list[VerifiedPair]:
    """Return matches as pixels, float64, of the pairs with any."""
    ends = {pair: match_ends(keypoints, pair, rows) for pair, rows in matches.items() if len(rows)}
    return [
        VerifiedPair(views=pair, first=first.double(), second=second.double())
        for pair, (first, second) in ends.items()
    ]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Features(Record):
    """Features of one photograph."""

    pixels: Float[Tensor, "feature 2"]
    descriptors: Float[Tensor, "feature length"]


class Near(NamedTuple):
    """Geometry that restricts which pixels of two photographs can show the same point.

    Attributes:
        matrix: Fundamental matrix, or homography from the first photograph to the second.
        max_error_px: Sampson's distance from the epipolar line, or distance from the mapped point.
    """

    matrix: Matrix3
    max_error_px: float
    planar: bool = False


# For each feature, the two largest products with allowed features of the other photograph, -1
# without; and the index of the largest.
Alike = tuple[Float[Tensor, "feature 2"], Int[Tensor, " feature"]]


def match_guided(
    space: Workspace, pairs: Sequence[PhotographPair], settings: ReconstructConfig
) -> None:
    """Replace the matches of verified pairs by those near their epipolar lines."""
    features: dict[int, Features] = {}
    with quiet(), loaded().Database.open(space.database) as database:
        image_of = image_ids(database, space)
        geometries, nears = {}, {}
        for pair in pairs:
            ends = (image_of[pair[0]], image_of[pair[1]])
            geometry = database.read_two_view_geometry(*ends)
            near = _near(geometry, settings.max_error_px)
            if near is not None:
                geometries[ends], nears[ends] = geometry, near
                for image in set(ends) - set(features):
                    features[image] = read_features(database, image)

        def matches(ends: tuple[int, int]) -> Int[Tensor, "match 2"]:
            first, second = (features[image] for image in ends)
            return guided_matches(first, second, nears[ends], settings.max_ratio)

        for ends, rows in zip(geometries, side_by_side(matches, list(geometries)), strict=True):
            if len(rows) >= MIN_MATCHES:
                geometries[ends].inlier_matches = rows.numpy().astype(np.uint32)
                database.update_two_view_geometry(*ends, geometries[ends])


def guided_matches(
    first: Features, second: Features, near: Near, max_ratio: float
) -> Int[Tensor, "match 2"]:
    """Return mutual matches among features that can show the same point."""
    forward, backward = most_similar(first, second, near)
    (source,) = torch.nonzero(_clearly_best(forward, max_ratio), as_tuple=True)
    target = forward[1][source]
    mutual = _clearly_best(backward, max_ratio)[target] & (backward[1][target] == source)
    return torch.stack([source, target], dim=1)[mutual]


def _near(geometry: Any, max_error_px: float) -> Near | None:  # noqa: ANN401 - pycolmap is untyped
    """Return the geometry that verified a pair; ``None`` for an unverified pair."""
    kinds = loaded().TwoViewGeometryConfiguration
    if geometry.config in (kinds.CALIBRATED, kinds.UNCALIBRATED):
        return Near(torch.from_numpy(np.array(geometry.F)), max_error_px)
    if geometry.config in (kinds.PLANAR, kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC):
        return Near(torch.from_numpy(np.array(geometry.H)), max_error_px, planar=True)
    return None


def most_similar(first: Features, second: Features, near: Near) -> tuple[Alike, Alike]:
    """Return the most similar features of two photographs that can show one point."""
    from pimper_torch.stages.sfm.kernels.line_matches import most_alike

    counts = len(first.pixels), len(second.pixels)
    products = [torch.full((count, 2), -1.0) for count in counts]
    best = [torch.full((count,), -1) for count in counts]
    most_alike(
        first.pixels.contiguous().numpy(),
        second.pixels.contiguous().numpy(),
        first.descriptors.contiguous().numpy(),
        second.descriptors.contiguous().numpy(),
        near.matrix.contiguous().numpy(),
        near.planar,
        near.max_error_px,
        *(x.numpy() for x in (*products, *best)),
    )
    return (products[0], best[0]), (products[1], best[1])


def _clearly_best(alike: Alike, max_ratio: float) -> Bool[Tensor, " feature"]:
    """Return the features whose smallest angle is small, and clearly smaller than the second."""
    best, rival = alike[0].clamp(0, 1).acos().unbind(dim=1)  # 90 degrees without a candidate
    farthest = loaded().FeatureMatchingOptions().sift.max_distance
    return (best < max_ratio * rival) & (best <= farthest)


def read_features(database: Any, image: int) -> Features:  # noqa: ANN401 - pycolmap is untyped
    """Read the features of an image in the database."""
    descriptors = np.array(database.read_descriptors(image).data).astype(np.float32)
    return Features(
        pixels=read_pixels(database, image).double(),
        descriptors=torch.from_numpy(descriptors / 512),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Verifier:
    """Photographs and matches of COLMAP's database, and verification of a subset, in parallel.

    Attributes:
        pairs: Matches before verification.
        geometries: Geometries of all pairs verified so far.
    """

    ids: tuple[int, ...]
    cameras: tuple[Any, ...]
    keypoints: Keypoints
    pairs: Matches
    settings: ReconstructConfig
    geometries: dict[PhotographPair, Any] = field(default_factory=dict)

    def __call__(self, pairs: Matches) -> dict[PhotographPair, Rows]:
        """Return the verified matches of each pair."""
        options = _verification(self.settings, MIN_MATCHES)
        # Enough if half of the matches are correct. COLMAP's own 10,000 take 0.1 s in each pair
        # with wrong moving matches, which are most pairs on a turntable.
        options.ransac.max_num_trials = 1000

        def geometry(pair: PhotographPair) -> Any:  # noqa: ANN401 - pycolmap is untyped
            first, second = ((self.cameras[i], self.keypoints[i].double().numpy()) for i in pair)
            rows = pairs[pair].numpy().astype(np.uint32)
            return loaded().estimate_two_view_geometry(*first, *second, rows, options)

        listed = list(pairs)
        self.geometries.update(
            zip(listed, side_by_side(geometry, listed, tracked=False), strict=True)
        )
        return {pair: indices(self.geometries[pair].inlier_matches) for pair in listed}


def read_verifier(database: Any, settings: ReconstructConfig) -> Verifier:  # noqa: ANN401 - pycolmap is untyped
    """Read features and matches."""
    images = sorted(database.read_all_images(), key=lambda image: image.name)
    ids = tuple(image.image_id for image in images)
    cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
    return Verifier(
        ids=ids,
        cameras=tuple(cameras[image.camera_id] for image in images),
        keypoints=[read_pixels(database, image) for image in ids],
        pairs={pair: indices(rows) for pair, rows in _pairs(database.read_all_matches(), ids)},
        settings=settings,
    )


def read_geometries(database: Any, images: Sequence[int]) -> dict[PhotographPair, Any]:  # noqa: ANN401
    """Read the geometries of verified pairs, keyed by indices into ``images``."""
    return dict(_pairs(database.read_two_view_geometries(), images))


def read_verified(database: Any, images: Sequence[int]) -> Matches:  # noqa: ANN401
    """Read the verified matches of the pairs with any, keyed by indices into ``images``."""
    geometries = read_geometries(database, images).items()
    return {pair: indices(g.inlier_matches) for pair, g in geometries if len(g.inlier_matches)}


def _pairs(listed: Any, images: Sequence[int]) -> Iterator[tuple[PhotographPair, Any]]:  # noqa: ANN401
    """Iterate over COLMAP's lists of image pairs, keyed by indices into ``images``."""
    number = {image: index for index, image in enumerate(images)}
    for pair_id, value in zip(*listed, strict=True):
        first, second = loaded().pair_id_to_image_pair(pair_id)
        yield (number[first], number[second]), value


def read_pixels(database: Any, image: int) -> Float[Tensor, "feature 2"]:  # noqa: ANN401
    """Read the pixels of an image's features."""
    return torch.from_numpy(np.array(database.read_keypoints(image))[:, :2].copy())


def match_ends(
    keypoints: Keypoints, pair: PhotographPair, rows: Rows
) -> tuple[Float[Tensor, "match 2"], Float[Tensor, "match 2"]]:
    """Return the pixels of a pair's matches in both photographs."""
    return keypoints[pair[0]][rows[:, 0]], keypoints[pair[1]][rows[:, 1]]


def add_votes(
    votes: Sequence[Tensor], pair: PhotographPair, rows: Rows, cast: Float[Tensor, "match 2"]
) -> None:
    """Add votes to the features at both ends of matches, in place."""
    for side, view in enumerate(pair):
        votes[view].index_add_(0, rows[:, side], cast[:, side].to(votes[view]))


def indices(rows: Any) -> Int[Tensor, "match 2"]:  # noqa: ANN401 - pycolmap is untyped
    """Convert COLMAP's matches to rows of a tensor."""
    return torch.from_numpy(np.array(rows).astype(np.int64)).reshape(-1, 2)


def among(matches: Int[Tensor, "match 2"], subset: Int[Tensor, "_ 2"]) -> Bool[Tensor, " match"]:
    """Return which matches are in a subset of them."""
    width = 1 + int(matches.max()) if len(matches) else 1
    keys, chosen = (rows[:, 0] * width + rows[:, 1] for rows in (matches, subset))
    return torch.isin(keys, chosen)
