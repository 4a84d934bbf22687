"""Features matched between pairs of photographs, and verified by an epipolar geometry."""

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

from pimper_torch.ground.geometry.colmap_library import loaded, quiet
from pimper_torch.ground.shapes import Matrix3
from pimper_torch.method.sfm.features import Workspace, image_ids
from pimper_torch.method.sfm.reconstruct_config import MIN_MATCHES, ReconstructConfig
from pimper_torch.records import Record
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.runtime.progress import track
from pimper_torch.runtime.scratch import scratch

# Photographs up to which a set is small: every pair is matched, and every point is looked for in
# every view. Beyond, work grows with their number, not its square; see docs/decisions.md.
MOST_PAIRED = 66

PhotographPair = tuple[int, int]
"""Numbers of two photographs, the lower one first."""
Keypoints = Sequence[Float[Tensor, "_ 2"]]
"""Pixels of features, photograph by photograph."""
Rows = Int[Tensor, "match 2"]
"""A feature of the first photograph and one of the second in each row."""
Matches = Mapping[PhotographPair, Rows]
Verify = Callable[[Matches], Matches]
"""Those of each pair's matches that one epipolar geometry explains."""


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
    """Match pairs of photographs that are not matched yet, and verify the matches."""
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
    # COLMAP prepares the search in a photograph once a tile: of 66, tiles of 16 prepare 400
    # searches where tiles of 8 prepare 648.
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
        mine = [pair for pair in counts if view in pair]
        chosen.update(sorted(mine, key=lambda pair: (-counts[pair], pair))[:most])
    return sorted(chosen)


def verified_pairs(space: Workspace) -> list[VerifiedPair]:
    """Read the matches that were verified, pair by pair."""
    with quiet(), loaded().Database.open(space.database) as stored:
        images = image_ids(stored, space)
        pixels = [read_pixels(stored, image) for image in images]
        geometries = read_geometries(stored, images)
    rows = {pair: indices(one.inlier_matches) for pair, one in geometries.items()}
    return pairs_of(pixels, rows)


def pairs_of(keypoints: Keypoints, matches: Matches) -> list[VerifiedPair]:
    """Return matches as pixels, float64, of the pairs that have some."""
    ends = {pair: pixels_of(keypoints, pair, rows) for pair, rows in matches.items() if len(rows)}
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
    """Which pixels of two photographs can show the same point.

    Attributes:
        matrix: Fundamental matrix, or homography from the first photograph to the second.
        max_error_px: Sampson's distance from the epipolar line, or that from the mapped point.
    """

    matrix: Matrix3
    max_error_px: float
    planar: bool = False


# Of each feature, the two largest products with near ones of the other photograph, -1 without; and
# which the largest is with.
Alike = tuple[Float[Tensor, "feature 2"], Int[Tensor, " feature"]]


def match_guided(
    space: Workspace, pairs: Sequence[PhotographPair], settings: ReconstructConfig
) -> None:
    """Replace the matches of verified pairs by those near their epipolar lines."""
    features: dict[int, Features] = {}
    with quiet(), loaded().Database.open(space.database) as stored:
        image_of = image_ids(stored, space)
        geometries, nears = {}, {}
        for pair in pairs:
            ends = (image_of[pair[0]], image_of[pair[1]])
            geometry = stored.read_two_view_geometry(*ends)
            near = _near(geometry, settings.max_error_px)
            if near is not None:
                geometries[ends], nears[ends] = geometry, near
                for image in set(ends) - set(features):
                    features[image] = read_features(stored, image)

        def matches(ends: tuple[int, int]) -> Int[Tensor, "match 2"]:
            first, second = (features[image] for image in ends)
            return guided_matches(first, second, nears[ends], settings.max_ratio)

        for ends, found in zip(geometries, side_by_side(matches, list(geometries)), strict=True):
            if len(found) >= MIN_MATCHES:
                geometries[ends].inlier_matches = found.numpy().astype(np.uint32)
                stored.update_two_view_geometry(*ends, geometries[ends])


def guided_matches(
    first: Features, second: Features, near: Near, max_ratio: float
) -> Int[Tensor, "match 2"]:
    """Match features among those that can show the same point."""
    one, other = likeness(first, second, near)
    (mine,) = torch.nonzero(_clearly_best(one, max_ratio), as_tuple=True)
    theirs = one[1][mine]
    mutual = _clearly_best(other, max_ratio)[theirs] & (other[1][theirs] == mine)
    return torch.stack([mine, theirs], dim=1)[mutual]


def _near(geometry: Any, max_error_px: float) -> Near | None:  # noqa: ANN401 - pycolmap is untyped
    """Choose by what verified a pair; nothing for a pair that was not."""
    kinds = loaded().TwoViewGeometryConfiguration
    if geometry.config in (kinds.CALIBRATED, kinds.UNCALIBRATED):
        return Near(torch.from_numpy(np.array(geometry.F)), max_error_px)
    if geometry.config in (kinds.PLANAR, kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC):
        return Near(torch.from_numpy(np.array(geometry.H)), max_error_px, planar=True)
    return None


def likeness(first: Features, second: Features, near: Near) -> tuple[Alike, Alike]:
    """Find the most similar features of two photographs, among those that can show one point."""
    from pimper_torch.ground.kernels.line_matches import most_alike

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
        *(each.numpy() for each in (*products, *best)),
    )
    return (products[0], best[0]), (products[1], best[1])


def _clearly_best(alike: Alike, max_ratio: float) -> Bool[Tensor, " feature"]:
    """Find whose smallest angle is small, and the second smallest enough larger."""
    best, rival = alike[0].clamp(0, 1).acos().unbind(dim=1)  # without one, a right angle
    farthest = loaded().FeatureMatchingOptions().sift.max_distance
    return (best < max_ratio * rival) & (best <= farthest)


def read_features(stored: Any, image: int) -> Features:  # noqa: ANN401 - pycolmap is untyped
    """Read the features of an image of the database."""
    descriptors = np.array(stored.read_descriptors(image).data).astype(np.float32)
    return Features(
        pixels=read_pixels(stored, image).double(), descriptors=torch.from_numpy(descriptors / 512)
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Matched:
    """Photographs and matches of COLMAP's database before verification."""

    ids: tuple[int, ...]
    cameras: tuple[Any, ...]
    keypoints: Keypoints
    pairs: Matches


def read_matched(stored: Any) -> Matched:  # noqa: ANN401 - pycolmap has no types before it is loaded
    """Read features and matches."""
    images = sorted(stored.read_all_images(), key=lambda image: image.name)
    ids = tuple(image.image_id for image in images)
    cameras = {camera.camera_id: camera for camera in stored.read_all_cameras()}
    return Matched(
        ids=ids,
        cameras=tuple(cameras[image.camera_id] for image in images),
        keypoints=[read_pixels(stored, image) for image in ids],
        pairs={pair: indices(rows) for pair, rows in _pairs(stored.read_all_matches(), ids)},
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Verifier:
    """COLMAP's verification of some of the matches of pairs, side by side.

    In a database of its own: COLMAP's function for one pair would hold Python's lock.

    Attributes:
        geometries: Those that were found.
    """

    matched: Matched
    settings: ReconstructConfig
    geometries: dict[PhotographPair, Any] = field(default_factory=dict)

    def __call__(self, pairs: Matches) -> dict[PhotographPair, Rows]:
        """Return the matches that are verified."""
        pycolmap, matched, settings = loaded(), self.matched, self.settings
        options = pycolmap.TwoViewGeometryOptions()
        options.min_num_inliers = MIN_MATCHES
        options.ransac.max_error = settings.max_error_px
        options.ransac.random_seed = settings.seed
        # Enough where half of the matches are right. COLMAP's own 10,000 take 0.1 s in each pair
        # whose moving matches are wrong, and on a turntable those are most.
        options.ransac.max_num_trials = 1000
        verifying = pycolmap.GeometricVerifierOptions()
        verifying.num_threads = settings.num_threads
        ids = {pair: tuple(matched.ids[view] for view in pair) for pair in pairs}
        with scratch() as folder:
            path = folder / "pairs.db"
            with pycolmap.Database.open(path) as stored:
                for camera in {camera.camera_id: camera for camera in matched.cameras}.values():
                    stored.write_camera(camera, use_camera_id=True)
                views = zip(matched.ids, matched.cameras, matched.keypoints, strict=True)
                for image, camera, pixels in views:
                    known = pycolmap.Image(
                        name=str(image), camera_id=camera.camera_id, image_id=image
                    )
                    stored.write_image(known, use_image_id=True)
                    stored.write_keypoints(image, pixels.numpy())
                for pair, rows in pairs.items():
                    stored.write_matches(*ids[pair], rows.numpy().astype(np.uint32))
            pycolmap.geometric_verification(path, verifying, two_view_geometry_options=options)
            with pycolmap.Database.open(path) as stored:
                found = {pair: stored.read_two_view_geometry(*ids[pair]) for pair in pairs}
        self.geometries.update(found)
        return {pair: indices(geometry.inlier_matches) for pair, geometry in found.items()}


def read_geometries(stored: Any, images: Sequence[int]) -> dict[PhotographPair, Any]:  # noqa: ANN401
    """Read the geometries of verified pairs, by positions among images."""
    return dict(_pairs(stored.read_two_view_geometries(), images))


def _pairs(listed: Any, images: Sequence[int]) -> Iterator[tuple[PhotographPair, Any]]:  # noqa: ANN401
    """Go through what COLMAP lists of pairs of images, by their positions among some."""
    number = {image: index for index, image in enumerate(images)}
    for pair_id, one in zip(*listed, strict=True):
        first, second = loaded().pair_id_to_image_pair(pair_id)
        yield (number[first], number[second]), one


def read_pixels(stored: Any, image: int) -> Float[Tensor, "feature 2"]:  # noqa: ANN401
    """Read where an image's features are."""
    return torch.from_numpy(np.array(stored.read_keypoints(image))[:, :2].copy())


def pixels_of(
    keypoints: Keypoints, pair: PhotographPair, rows: Rows
) -> tuple[Float[Tensor, "match 2"], Float[Tensor, "match 2"]]:
    """Return the pixels of a pair's matches in both photographs."""
    return keypoints[pair[0]][rows[:, 0]], keypoints[pair[1]][rows[:, 1]]


def add_votes(
    votes: Sequence[Tensor], pair: PhotographPair, rows: Rows, cast: Float[Tensor, "match 2"]
) -> None:
    """Add to the votes of both ends of matches, in place."""
    for side, view in enumerate(pair):
        votes[view].index_add_(0, rows[:, side], cast[:, side].to(votes[view]))


def indices(rows: Any) -> Int[Tensor, "match 2"]:  # noqa: ANN401 - see read_matched
    """Turn COLMAP's matches into rows of a tensor."""
    return torch.from_numpy(np.array(rows).astype(np.int64)).reshape(-1, 2)


def among(matches: Int[Tensor, "match 2"], some: Int[Tensor, "some 2"]) -> Bool[Tensor, " match"]:
    """Find the matches that are among some of them."""
    width = 1 + int(matches.max()) if len(matches) else 1
    keys, chosen = (rows[:, 0] * width + rows[:, 1] for rows in (matches, some))
    return torch.isin(keys, chosen)
