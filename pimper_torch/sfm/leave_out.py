"""Leave features of a room at rest out of COLMAP's database."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.ledger import leave_out
from pimper_torch.sfm.binding import loaded, quiet
from pimper_torch.sfm.camera_in_place import (
    mapped,
    reference_from_photographs,
    shift_px,
    still_length_px,
)
from pimper_torch.sfm.reconstruct_config import MIN_MATCHES, ReconstructConfig
from pimper_torch.sfm.static_background import (
    Keypoints,
    Pair,
    StaticBackground,
    find_static_background,
    moving_matches,
)

# Measured on 24 rendered photographs of 640x480: 99 % of the matches of a room at rest are
# shorter, and 0.4 % of those of a turning mug.
STILL_PX = 1.0
# Where the room shifts and is brought back: measured on 20 rendered photographs of 800x600, panned
# by up to 80 px, 99 % of its matches are shorter, and 0.8 % of those of a turning mug.
_SHIFTED_PX = 2.0
# Of RANSAC: enough where half of the matches are right. COLMAP's own 10,000 take 0.1 s in each pair
# whose moving matches are wrong, and on a turntable those are most.
_TRIALS = 1000


def leave_out_room(database: Path, settings: ReconstructConfig) -> StaticBackground:
    """Find what is at rest while something else moves, and keep features and matches of the latter.

    Where the room shifts from photograph to photograph, because the camera was turned in its place
    or pictures were cropped, it is at rest once photographs are mapped to one of them, see
    :mod:`pimper_torch.sfm.camera_in_place`. Pairs that were verified on what is at rest are
    verified anew.

    Args:
        database: With features, matches and verified pairs. Where nothing is at rest it stays
            as it is.

    Returns:
        What was found, with the former features in the order of the photographs' names.
    """
    pycolmap = loaded()

    with quiet(), pycolmap.Database.open(database) as stored:
        matched = read_matched(stored)
        verifier = _Verifier(matched=matched, settings=settings)
        found = _shifted(matched, verifier, settings) or _at_rest(matched, verifier, settings)
        if found.rest.room:
            geometries = read_geometries(stored) | verifier.found
            _drop_features(stored, matched, found.rest)
            _drop_matches(stored, matched, found, geometries)
            return found.rest.replace(maps=_maps(found))
    return found.rest


def enter_room(rest: StaticBackground) -> tuple[int, int]:
    """Enter in the ledger how many features rest with a room; return their and all numbers."""
    resting = sum(int(one.sum()) for one in rest.features)
    total = sum(map(len, rest.features))
    leave_out("sfm.shifted_room" if rest.shift_px else "sfm.room", resting, total=total)
    return resting, total


def _maps(found: "_Found") -> tuple[Float[Tensor, "3 3"], ...]:
    """Return the maps of photographs that show enough features of the room."""
    pairs = zip(found.maps, found.rest.features, strict=True)
    return tuple(
        one if int(resting.sum()) >= MIN_MATCHES else torch.full_like(one, torch.nan)
        for one, resting in pairs
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Matched:
    """Photographs and matches of COLMAP's database before verification.

    Attributes:
        ids: Of the photographs in the database, in the order of their names.
    """

    ids: tuple[int, ...]
    cameras: tuple[Any, ...]
    keypoints: Keypoints
    pairs: tuple[Pair, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Found:
    """Static background between mapped pixels of photographs."""

    rest: StaticBackground
    maps: tuple[Float[Tensor, "3 3"], ...]
    keypoints: Keypoints
    still_px: float


def _at_rest(matched: Matched, verifier: "_Verifier", settings: ReconstructConfig) -> _Found:
    maps = tuple(torch.eye(3, dtype=torch.float64) for _ in matched.keypoints)
    return _find(matched.keypoints, maps, verifier, settings, STILL_PX)


def _shifted(matched: Matched, verifier: "_Verifier", settings: ReconstructConfig) -> _Found | None:
    """Find a room that shifts before a camera that stays in its place, if there is one."""
    maps = reference_from_photographs(
        matched.keypoints,
        matched.pairs,
        max_error_px=_SHIFTED_PX,
        fewest=MIN_MATCHES,
        generator=torch.Generator().manual_seed(settings.seed),
    )
    if maps is None:
        return None
    pixels = [mapped(*one).float() for one in zip(maps, matched.keypoints, strict=True)]
    still_px = still_length_px(pixels, matched.pairs, _SHIFTED_PX)
    found = _find(pixels, maps, verifier, settings, still_px)
    if not found.rest.room:
        return None
    shift = shift_px(maps, matched.keypoints)
    return replace(found, rest=found.rest.replace(shift_px=shift))


def _find(
    keypoints: Keypoints,
    maps: tuple[Float[Tensor, "3 3"], ...],
    verifier: "_Verifier",
    settings: ReconstructConfig,
    still_px: float,
) -> _Found:
    rest = find_static_background(
        keypoints,
        verifier.matched.pairs,
        verifier,
        still_px=still_px,
        max_error_px=settings.max_error_px,
        fewest=MIN_MATCHES,
    )
    return _Found(rest=rest, maps=maps, keypoints=keypoints, still_px=still_px)


def read_matched(stored: Any) -> Matched:  # noqa: ANN401 - pycolmap has no types before it is loaded
    """Read features and matches."""
    pycolmap = loaded()

    images = sorted(stored.read_all_images(), key=lambda image: image.name)
    number = {image.image_id: index for index, image in enumerate(images)}
    cameras = {camera.camera_id: camera for camera in stored.read_all_cameras()}
    pairs = []
    for pair_id, rows in zip(*stored.read_all_matches(), strict=True):
        first, second = pycolmap.pair_id_to_image_pair(pair_id)
        pairs.append(Pair(first=number[first], second=number[second], matches=indices(rows)))
    return Matched(
        ids=tuple(image.image_id for image in images),
        cameras=tuple(cameras[image.camera_id] for image in images),
        keypoints=[
            torch.from_numpy(np.array(stored.read_keypoints(image.image_id))[:, :2].copy())
            for image in images
        ],
        pairs=tuple(pairs),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Verifier:
    """COLMAP's verification of matches; keeps the geometries."""

    matched: Matched
    settings: ReconstructConfig
    found: dict[tuple[int, int], Any] = field(default_factory=dict)

    def __call__(self, pairs: Sequence[Pair]) -> list[Int[Tensor, "match 2"]]:
        ids = [(self.matched.ids[pair.first], self.matched.ids[pair.second]) for pair in pairs]
        found = verified_again(self.matched, pairs, self.settings)
        self.found.update(zip(ids, found, strict=True))
        return [indices(geometry.inlier_matches) for geometry in found]


def verified_again(
    matched: Matched, pairs: Sequence[Pair], settings: ReconstructConfig
) -> list[Any]:
    """Find COLMAP's geometries of some of the matches of pairs, side by side.

    In a database of their own: COLMAP's function for one pair would hold Python's lock.
    """
    pycolmap = loaded()

    ids = [(matched.ids[pair.first], matched.ids[pair.second]) for pair in pairs]
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers = MIN_MATCHES
    options.ransac.max_error = settings.max_error_px
    options.ransac.random_seed = settings.seed
    options.ransac.max_num_trials = _TRIALS
    verifying = pycolmap.GeometricVerifierOptions()
    verifying.num_threads = settings.num_threads
    with tempfile.TemporaryDirectory(prefix="pimper_") as folder:
        path = Path(folder) / "pairs.db"
        with pycolmap.Database.open(path) as stored:
            for camera in {camera.camera_id: camera for camera in matched.cameras}.values():
                stored.write_camera(camera, use_camera_id=True)
            views = zip(matched.ids, matched.cameras, matched.keypoints, strict=True)
            for image, camera, pixels in views:
                known = pycolmap.Image(name=str(image), camera_id=camera.camera_id, image_id=image)
                stored.write_image(known, use_image_id=True)
                stored.write_keypoints(image, pixels.numpy())
            for ends, pair in zip(ids, pairs, strict=True):
                stored.write_matches(*ends, pair.matches.numpy().astype(np.uint32))
        pycolmap.geometric_verification(path, verifying, two_view_geometry_options=options)
        with pycolmap.Database.open(path) as stored:
            return [stored.read_two_view_geometry(*ends) for ends in ids]


def read_geometries(stored: Any) -> dict[tuple[int, int], Any]:  # noqa: ANN401 - see read_matched
    """Read the geometries of verified pairs, by the numbers of their images."""
    pycolmap = loaded()

    return {
        tuple(pycolmap.pair_id_to_image_pair(pair_id)): geometry
        for pair_id, geometry in zip(*stored.read_two_view_geometries(), strict=True)
    }


def _drop_features(stored: Any, matched: Matched, rest: StaticBackground) -> None:  # noqa: ANN401 - see read_matched
    pycolmap = loaded()

    descriptors = [stored.read_descriptors(image) for image in matched.ids]
    stored.clear_descriptors()
    for image, resting, described in zip(matched.ids, rest.features, descriptors, strict=True):
        kept = (~resting).numpy()
        stored.update_keypoints(image, np.array(stored.read_keypoints(image))[kept])
        stored.write_descriptors(
            image, pycolmap.FeatureDescriptors(described.type, described.data[kept])
        )


def _drop_matches(
    stored: Any,  # noqa: ANN401 - see read_matched
    matched: Matched,
    found: _Found,
    geometries: dict[tuple[int, int], Any],
) -> None:
    number = [torch.cumsum(~resting, dim=0) - 1 for resting in found.rest.features]
    stored.clear_matches()
    stored.clear_two_view_geometries()

    def kept(pair: Pair) -> npt.NDArray[np.uint32]:
        moves = moving_matches(found.keypoints, pair, found.rest, found.still_px)
        first, second = pair.matches[moves].unbind(dim=1)
        rows = torch.stack([number[pair.first][first], number[pair.second][second]], dim=1)
        return rows.numpy().astype(np.uint32)

    for pair in matched.pairs:
        ids = matched.ids[pair.first], matched.ids[pair.second]
        stored.write_matches(*ids, kept(pair))
        if ids in geometries:
            geometry = geometries[ids]
            inliers = kept(pair.replace(matches=indices(geometry.inlier_matches)))
            if len(inliers) >= MIN_MATCHES:
                geometry.inlier_matches = inliers
                stored.write_two_view_geometry(*ids, geometry)


def indices(rows: Any) -> Int[Tensor, "match 2"]:  # noqa: ANN401 - see read_matched
    """Turn COLMAP's matches into rows of a tensor."""
    return torch.from_numpy(np.array(rows).astype(np.int64)).reshape(-1, 2)


def among(matches: Int[Tensor, "match 2"], some: Int[Tensor, "some 2"]) -> Bool[Tensor, " match"]:
    """Find the matches that are among some of them."""
    width = 1 + int(matches.max()) if len(matches) else 1
    keys, chosen = (rows[:, 0] * width + rows[:, 1] for rows in (matches, some))
    return torch.isin(keys, chosen)
