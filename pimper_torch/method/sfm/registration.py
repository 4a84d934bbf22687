"""Photographs registered in one model: the plain explanation first, others only where it fails.

The plain explanation is one rigid scene. A model of all photographs that explains nearly all
verified matches is the result, whatever else pairs of photographs may show. Otherwise a room at
rest before a turning object is looked for, and an object that was moved on its table; one of these
is taken if it explains clearly more of its verified matches.
"""

import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count

from pimper_torch.ground.geometry.colmap_library import loaded, quiet
from pimper_torch.ground.shapes import Matrix3
from pimper_torch.method.sfm.colmap import model_of
from pimper_torch.method.sfm.diagnose import (
    FEWEST_VIEWS,
    MOVE,
    count_views_with_depth,
    diagnose,
    verify_model,
)
from pimper_torch.method.sfm.features import Workspace
from pimper_torch.method.sfm.matching import (
    MOST_PAIRED,
    VerifiedPair,
    all_pairs,
    match_guided,
    match_pairs,
    strongest,
    verified_pairs,
)
from pimper_torch.method.sfm.model import SparseModel, drop_weak_views
from pimper_torch.method.sfm.moved_object import link_sessions
from pimper_torch.method.sfm.reconstruct_config import MIN_POINTS, ReconstructConfig
from pimper_torch.method.sfm.retrieval import pairs_to_match
from pimper_torch.method.sfm.static_background import log_static_features, remove_static_features
from pimper_torch.runtime.errors import ReconstructionError, caution
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.progress import report


def map_views(space: Workspace, seed: int, *, pairs_count: bool = False) -> list[SparseModel]:
    """Grow models from the best pair of views on, until no view can be added.

    On one thread, so that the same matches give the same bits.

    Args:
        pairs_count: Points that only two views see take part, too: they tie views with
            little overlap, less exactly.

    Returns:
        One model a component, the one with most views first. Names are files of ``space``.
    """
    pycolmap = loaded()

    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 3
    options.extract_colors = False
    options.num_threads = 1
    options.random_seed = seed
    options.mapper.abs_pose_min_num_inliers = MIN_POINTS
    # Short adjustments take half of the CPU s (docs/decisions.md): all is adjusted to tracks later.
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.4
    options.ba_global_max_refinements, options.ba_local_max_refinements = 2, 1
    options.ba_global_function_tolerance = options.ba_local_function_tolerance = 1e-4
    options.ba_local_max_num_iterations, options.mapper.ba_local_num_images = 10, 4
    options.triangulation.ignore_two_view_tracks = not pairs_count
    registered, total = count(3), len(space.files)  # the first call follows a model of two views

    def on_image() -> None:
        report(min(next(registered), total), total)  # models that begin anew add views again

    with tempfile.TemporaryDirectory(dir=space.folder) as output, quiet():
        found = pycolmap.incremental_mapping(
            space.database, space.images, output, options, next_image_callback=on_image
        )
    models = [model_of(reconstruction) for reconstruction in found.values()]
    return sorted(models, key=lambda model: (-model.num_views, -len(model.points_world)))


# Fraction of the verified matches that a plain model must explain. Right models of 12 potatoes on a
# patterned table explain 0.99 to 1.00, with a time stamp in the corner or a zoom in EXIF, too, and
# 0.95 where zoomed photographs share a lens; of a mug that was turned over, at most 0.73.
_EXPLAINED = 0.9
# What another explanation must explain beyond the plain one's fraction; a mug that was turned over
# gains 0.25: a choice between.
_MARGIN = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Registration:
    """Result of one run of the mapper.

    Attributes:
        models: One a component, the one with most views that see depth first.
        spread: Views of each that see depth.
        missing: Files that the first model lacks; all without a model.
        misplaced: Files of the first model whose strongest pairs contradict it, and the fraction of
            the matches in those that agrees.
        explained: Fraction of the verified matches that the first model explains; 0 where its
            cameras are doubtful.
        background: Map from each file's pixels to those where a static background is at rest, see
            :class:`~pimper_torch.method.sfm.static_background.StaticBackground`.
        around: Matches of the surroundings on which the object was moved between series of files;
            none where it was not.
    """

    models: tuple[SparseModel, ...]
    spread: tuple[int, ...]
    missing: tuple[str, ...]
    misplaced: Mapping[str, float]
    inlier_ratio: float
    background: tuple[Matrix3, ...] = ()
    around: tuple[VerifiedPair, ...] = ()

    @property
    def complete(self) -> bool:
        """True where every photograph is registered, none misplaced, and some see depth."""
        return not self.missing and not self.misplaced and self.spread[0] >= FEWEST_VIEWS

    @property
    def sound(self) -> bool:
        """True where nothing speaks against the model."""
        return self.complete and self.inlier_ratio >= _EXPLAINED

    @property
    def rank(self) -> tuple[bool, int, int]:
        """Order registrations: those that see depth, by views not misplaced, then points."""
        if not self.models:
            return False, 0, 0
        model = self.models[0]
        placed = model.num_views - len(self.misplaced)
        return self.spread[0] >= FEWEST_VIEWS, placed, len(model.points_world)


def register(space: Workspace, settings: ReconstructConfig) -> Registration:
    """Match pairs and grow a model; look for another explanation only where that fails.

    Other explanations are a room at rest before which the object turns: its features are left out;
    and an object that was moved between two series of photographs: between these only matches of
    the object are used, see :mod:`pimper_torch.method.sfm.moved_object`.

    Where a model stays incomplete or contradicts matches, the thorough pass matches along epipolar
    lines: pairs of missing photographs, or all where some are misplaced. Then it starts the mapper
    several times, with other random numbers, and at last lets points count that only two views see.
    The first complete model ends it.

    Of more than :data:`~pimper_torch.method.sfm.matching.MOST_PAIRED` photographs only pairs of
    those that look alike are matched, see :mod:`pimper_torch.method.sfm.retrieval`; and in the
    thorough pass those of missing or misplaced photographs with all others.
    """
    match_pairs(space, pairs_to_match(space), settings)
    other = replace(space, database_name="other.db")  # for matches of another hypothesis
    shutil.copyfile(space.database, other.database)
    plain = _registered(space, settings)
    if plain.sound:
        return plain
    background = remove_static_features(other.database, settings)
    if background.nothing_moves:
        raise ReconstructionError(
            f"Nothing moves in {len(space.files)} photographs: {background.static_fraction:.0%} of "
            "the matches lie at the same pixel, and in no pair do enough others agree on a motion. "
            "Camera and background were at rest, and an object that turned has too little "
            f"texture. {MOVE}"
        )
    around = () if background.detected else link_sessions(other.database, settings)
    if not background.detected and not around:
        return _thorough(space, plain, settings)
    rival = _registered(other, settings)
    if not rival.sound:
        rival, plain = (_thorough(*one, settings) for one in ((other, rival), (space, plain)))
    if rival.inlier_ratio <= plain.inlier_ratio + _MARGIN:
        return plain
    if background.detected:
        left, total = log_static_features(background)
        caution(
            f"{left} of {total} features lie still in the photographs while others move: they are "
            "taken for those of a room before which the object turns, and are left out.",
            stacklevel=2,
        )
    else:
        surroundings = sum(pair.num_matches for pair in around)
        verified = sum(pair.num_matches for pair in verified_pairs(space))
        leave_out("sfm.moved_object", surroundings, total=verified)
    return replace(rival, background=tuple(background.maps), around=around)


def _registered(space: Workspace, settings: ReconstructConfig) -> Registration:
    verified = verified_pairs(space)
    if settings.guided_pairs:
        counts = {pair.views: pair.num_matches for pair in verified}
        match_guided(space, strongest(counts, len(space.files), settings.guided_pairs), settings)
        verified = verified_pairs(space)
    return _mapped(space, verified, settings, settings.seed)


def _thorough(space: Workspace, best: Registration, settings: ReconstructConfig) -> Registration:
    """Match more pairs along epipolar lines and start the mapper again, if a model needs it."""
    if best.complete or not settings.starts:
        return best
    small = len(space.files) <= MOST_PAIRED
    apart = {space.files.index(file) for file in (*best.missing, *best.misplaced)}
    again = all_pairs(len(space.files))
    if not small or not best.misplaced:
        again = [pair for pair in again if apart & set(pair)]
    if not small:
        match_pairs(space, again, settings)
    match_guided(space, again, settings)
    verified = verified_pairs(space)
    seeds = [settings.seed + start for start in range(settings.starts)]
    for seed, pairs_count in [*((seed, False) for seed in seeds), (settings.seed, True)]:
        rival = _mapped(space, verified, settings, seed, pairs_count=pairs_count)
        best = max(best, rival, key=lambda one: one.rank)
        if best.complete:
            break
    return best


def _mapped(
    space: Workspace,
    verified: Sequence[VerifiedPair],
    settings: ReconstructConfig,
    seed: int,
    *,
    pairs_count: bool = False,
) -> Registration:
    """Grow models, and judge the first.

    Args:
        pairs_count: Points that two views see make poses less exact where all views register
            without them (median error 0.19 in place of 0.13 degrees on 24 photographs of a skull):
            they come last.
    """
    grown = map_views(space, seed, pairs_count=pairs_count)
    strong = (drop_weak_views(model, MIN_POINTS) for model in grown)
    found = [model for model in strong if model.num_views]
    counted = list(zip(count_views_with_depth(found, MIN_POINTS), found, strict=True))
    counted.sort(key=lambda one: (-one[0], -one[1].num_views, -len(one[1].points_world)))
    models = tuple(model for _, model in counted)
    if not models:
        return Registration(
            models=(), spread=(), missing=space.files, misplaced={}, inlier_ratio=0.0
        )
    # At twice the distance that verifies a match it still agrees: the lens is the model's.
    consistency = verify_model(models[0], space.files, verified, 2 * settings.max_error_px)
    doubtful = bool(diagnose(models[0], len(space.files)))
    return Registration(
        models=models,
        spread=tuple(spread for spread, _ in counted),
        missing=tuple(file for file in space.files if file not in models[0].names),
        misplaced=consistency.misplaced,
        inlier_ratio=0.0 if doubtful else consistency.inlier_ratio,
    )
