"""Registration of photographs in one model: the simplest hypothesis first, others only if it fails.

The simplest hypothesis is one rigid scene. A model of all photographs that explains nearly all
verified matches is the result, whatever else pairs of photographs may indicate. Otherwise, a static
background behind a turning object and an object that was moved on its support are tested; one of
these is chosen if it explains clearly more of its verified matches.
"""

import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count

import torch

from pimper_torch.geometry.colmap_library import loaded, quiet
from pimper_torch.records.shapes import Matrix3
from pimper_torch.records.sparse_model import SparseModel, drop_weak_views
from pimper_torch.runtime.errors import ReconstructionError, caution
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.progress import report
from pimper_torch.stages.sfm.colmap import model_of
from pimper_torch.stages.sfm.diagnose import (
    FEWEST_VIEWS,
    MOVE,
    count_views_with_depth,
    diagnose,
    verify_model,
)
from pimper_torch.stages.sfm.features import Workspace
from pimper_torch.stages.sfm.matching import (
    MOST_PAIRED,
    VerifiedPair,
    all_pairs,
    match_guided,
    match_pairs,
    strongest,
    verified_pairs,
)
from pimper_torch.stages.sfm.moved_object import link_sessions
from pimper_torch.stages.sfm.reconstruct_config import MIN_POINTS, ReconstructConfig
from pimper_torch.stages.sfm.retrieval import pairs_to_match
from pimper_torch.stages.sfm.static_background import remove_static_features


def map_views(space: Workspace, seed: int, *, pairs_count: bool = False) -> list[SparseModel]:
    """Grow models from the best pair of views, until no view can be added.

    Runs on one thread, so that results are reproducible bit for bit.

    Args:
        pairs_count: Also use points of only two views: they link views with little overlap, less
            exactly.

    Returns:
        One model per component, the one with most views first. Names are files of ``space``.
    """
    pycolmap = loaded()

    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 3
    options.extract_colors = False
    options.num_threads = 1
    options.random_seed = seed
    options.mapper.abs_pose_min_num_inliers = MIN_POINTS
    # Short adjustments halve the CPU time (docs/decisions.md): tracks are adjusted later.
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.4
    options.ba_global_max_refinements, options.ba_local_max_refinements = 2, 1
    options.ba_global_function_tolerance = options.ba_local_function_tolerance = 1e-4
    options.ba_local_max_num_iterations, options.mapper.ba_local_num_images = 10, 4
    options.triangulation.ignore_two_view_tracks = not pairs_count
    registered, total = count(3), len(space.files)  # the first call follows a model of two views

    def on_image() -> None:
        report(min(next(registered), total), total)  # models that start again add views again

    with tempfile.TemporaryDirectory(dir=space.folder) as output, quiet():
        reconstructions = pycolmap.incremental_mapping(
            space.database, space.images, output, options, next_image_callback=on_image
        )
    models = [model_of(reconstruction) for reconstruction in reconstructions.values()]
    return sorted(models, key=lambda model: (-model.num_views, -len(model.points_world)))


# Least inlier ratio of the first model. Correct models of 12 potatoes on a patterned table have
# 0.99 to 1.00, also with a time stamp in the corner or a zoom in EXIF, and 0.95 if zoomed
# photographs share a lens; those of a mug that was turned over at most 0.73.
_MIN_INLIERS = 0.9
# Least gain in inlier ratio of an alternative; a mug that was turned over gains 0.25: a choice.
_MARGIN = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Registration:
    """Result of one run of the mapper.

    Attributes:
        models: One per component, the one with most views that see depth first.
        spread: Number of views of each that see depth.
        missing: Files that the first model lacks; all without a model.
        misplaced: Files of the first model whose strongest pairs contradict it, and the fraction of
            agreeing matches in those.
        inlier_ratio: Fraction of the verified matches that agree with the first model; 0 if its
            cameras are unreliable.
        background: Map from each file's pixels to the frame in which the background is static, see
            :class:`~pimper_torch.stages.sfm.static_background.StaticBackground`.
        around: Matches of the surroundings on which the object was moved between capture sessions;
            empty if it was not.
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
        """True if all photographs are registered, none is misplaced, and enough see depth."""
        return not self.missing and not self.misplaced and self.spread[0] >= FEWEST_VIEWS

    @property
    def sound(self) -> bool:
        """True if the model is complete and has enough inliers."""
        return self.complete and self.inlier_ratio >= _MIN_INLIERS

    @property
    def rank(self) -> tuple[bool, int, int]:
        """Sort key: whether enough views see depth, then views not misplaced, then points."""
        if not self.models:
            return False, 0, 0
        model = self.models[0]
        placed = model.num_views - len(self.misplaced)
        return self.spread[0] >= FEWEST_VIEWS, placed, len(model.points_world)


def register_photographs(space: Workspace, settings: ReconstructConfig) -> Registration:
    """Match pairs and map; test other hypotheses only if that fails.

    These are a static background behind a turning object, whose features are removed, and an object
    that was moved between capture sessions, between which only matches of the object are used, see
    :mod:`pimper_torch.stages.sfm.moved_object`.

    If a model stays incomplete or contradicts matches, the thorough pass matches along epipolar
    lines: pairs of missing photographs, or all if some are misplaced. Then it starts the mapper
    several times with different random numbers, and finally also with points of only two views. It
    ends at the first complete model.

    For more than :data:`~pimper_torch.stages.sfm.matching.MOST_PAIRED` photographs, only pairs of
    similar ones are matched, see :mod:`pimper_torch.stages.sfm.retrieval`, and in the thorough pass
    missing or misplaced photographs with all others.
    """
    match_pairs(space, pairs_to_match(space), settings)
    other = replace(space, database=space.folder / "other.db")  # for an alternative hypothesis
    shutil.copyfile(space.database, other.database)
    plain = _registered(space, settings)
    if plain.sound:
        return plain
    background = remove_static_features(other.database, settings)
    if background.nothing_moves:
        raise ReconstructionError(
            f"Nothing moves in {len(space.files)} photographs: {background.static_fraction:.0%} of "
            "the matches are at the same pixel, and in no pair do enough others agree on a motion. "
            "Camera and background were static, and the object, if it turned, has too little "
            f"texture. {MOVE}"
        )
    around = () if background.detected else link_sessions(other.database, settings)
    if not background.detected and not around:
        return _thorough(space, plain, settings)
    rival = _registered(other, settings)
    if not rival.sound:
        rival, plain = (_thorough(*run, settings) for run in ((other, rival), (space, plain)))
    if rival.inlier_ratio <= plain.inlier_ratio + _MARGIN:
        return plain
    if background.detected:
        static = torch.cat(background.features)
        leave_out("sfm.static_background", static)
        caution(
            f"{int(static.sum())} of {len(static)} features are static while others move. They are "
            "treated as the static background of a turning object, and removed.",
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
    """Match more pairs along epipolar lines and map again, if the model is incomplete."""
    if best.complete or not settings.starts:
        return best
    small = len(space.files) <= MOST_PAIRED
    unreliable = {space.files.index(file) for file in (*best.missing, *best.misplaced)}
    pairs = all_pairs(len(space.files))
    if not small or not best.misplaced:
        pairs = [pair for pair in pairs if unreliable & set(pair)]
    if not small:
        match_pairs(space, pairs, settings)
    match_guided(space, pairs, settings)
    verified = verified_pairs(space)
    seeds = [settings.seed + start for start in range(settings.starts)]
    for seed, pairs_count in [*((seed, False) for seed in seeds), (settings.seed, True)]:
        rival = _mapped(space, verified, settings, seed, pairs_count=pairs_count)
        best = max(best, rival, key=lambda run: run.rank)
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
    """Grow models, and verify the first.

    Args:
        pairs_count: Also use points of two views. If all views register without them, they make
            poses less exact (median error 0.19 instead of 0.13 degrees on 24 photographs of a
            skull), so they are the last resort.
    """
    grown = map_views(space, seed, pairs_count=pairs_count)
    strong = (drop_weak_views(model, MIN_POINTS) for model in grown)
    kept = [model for model in strong if model.num_views]
    counted = list(zip(count_views_with_depth(kept, MIN_POINTS), kept, strict=True))
    counted.sort(key=lambda item: (-item[0], -item[1].num_views, -len(item[1].points_world)))
    models = tuple(model for _, model in counted)
    if not models:
        return Registration(
            models=(), spread=(), missing=space.files, misplaced={}, inlier_ratio=0.0
        )
    # Twice the distance of verification: the lens is now that of the model.
    max_error_px = 2 * settings.max_error_px
    inlier_ratio, misplaced = verify_model(models[0], space.files, verified, max_error_px)
    unreliable = bool(diagnose(models[0], len(space.files)))
    return Registration(
        models=models,
        spread=tuple(spread for spread, _ in counted),
        missing=tuple(file for file in space.files if file not in models[0].names),
        misplaced=misplaced,
        inlier_ratio=0.0 if unreliable else inlier_ratio,
    )
