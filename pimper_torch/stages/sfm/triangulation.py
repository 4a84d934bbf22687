"""Points for given cameras: matched along epipolar lines, with the cameras held fixed."""

import tempfile
from collections.abc import Sequence
from itertools import combinations

import numpy as np
import torch
from torch import Tensor

from pimper_torch.geometry.colmap_library import loaded, quiet
from pimper_torch.geometry.lens_models import pinholes_of
from pimper_torch.geometry.local_frame import local_origin, to_local
from pimper_torch.records import SparseScene, Views
from pimper_torch.records.sparse_model import SparseModel
from pimper_torch.runtime.errors import InputError, caution
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.memory import release_memory
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.stages.sfm import epipolar, features, matching
from pimper_torch.stages.sfm.cloud import cloud_tracks
from pimper_torch.stages.sfm.colmap import model_of, observation_errors, reconstruction_of
from pimper_torch.stages.sfm.reconstruct_config import MIN_MATCHES, ReconstructConfig
from pimper_torch.stages.sfm.refine_tracks import refine_tracks
from pimper_torch.stages.sfm.retrieval import pairs_to_match
from pimper_torch.stages.sfm.static_background import remove_static_features

# Observed points of the median view below which points are triangulated, and below which depth maps
# are also used. In a model of COLMAP's or our own a view has at least 30; the other is half of it.
FEWEST_OBSERVED, FEW_OBSERVED = 15, 30


def lacks_points(model: SparseModel | SparseScene, fewest: int = FEWEST_OBSERVED) -> bool:
    """Return whether the median view observes fewer points than ``fewest``."""
    count = model.num_views if isinstance(model, SparseModel) else model.cameras.num_views
    observed = torch.bincount(model.observation_view, minlength=count)
    return float(observed.double().median()) < fewest


def triangulate(
    views: Views, given: SparseModel, settings: ReconstructConfig, where: str
) -> SparseModel:
    """Triangulate points from photographs, with cameras held fixed.

    Features are detected and matched as in structure from motion. Inliers of the pairs' own
    epipolar geometry show whether the cameras belong to the photographs. Then features are matched
    again along the cameras' epipolar lines, triangulated, and refined in every view by aligning
    patches. One thread is used where the order of sums matters, for reproducible bits.

    Args:
        given: Cameras of the photographs, in their order. Their points are replaced if more are
            found. Points without observations are a cloud, which is also searched for.

    Returns:
        Given poses and lenses, bit for bit. If no more points are found, the given ones, with a
        :class:`~pimper_torch.runtime.errors.PimperWarning`.
    """
    cloud = given.points_world
    if len(cloud) and not len(given.observation_point):
        given = given.replace(points_world=cloud[:0])
    if features.too_small(views):
        _warn_of_no_points(0, where)
        return given
    lenses = list(range(views.num_views))  # one per photograph for COLMAP; they stay unchanged
    with features.workspace(views, settings.num_threads) as space:
        counts = features.find_features(space, settings, [None] * views.num_views, lenses)
        release_memory()
        if sum(count > 0 for count in counts) >= 2:
            matching.match_pairs(space, pairs_to_match(space), settings)
            background = remove_static_features(space.database, settings)
            leave_out("sfm.static_background", torch.cat(background.features))
        verified = matching.verified_pairs(space)
        require_agreement(given, verified, settings.max_error_px, where)
        offset = local_origin(given.cam_from_world, cloud)
        local = given.replace(cam_from_world=to_local(given.cam_from_world, offset))
        _match_along_lines(space, local, verified, settings)
        model = local.with_points(_triangulated(space, local, settings.seed))
    release_memory()
    from_cloud = ""
    if len(cloud) > len(given.points_world):
        shifted = cloud - cloud.new_tensor(offset)
        of_cloud = cloud_tracks(views, local.replace(points_world=shifted))
        model = model.joined(of_cloud)
        from_cloud = f", {len(of_cloud.points_world):,} of them found from the cloud that it names"
    if len(model.points_world):
        model = refine_tracks(views, model, settings.track_iterations, cameras=False)
    points = model.points_world + model.points_world.new_tensor(offset)
    model = given.with_points(model.replace(points_world=points))
    if len(model.observation_point) <= len(given.observation_point) or not len(model.points_world):
        _warn_of_no_points(len(model.points_world), where)
        return given
    caution(
        f"{where}: hardly any of its views observes points. {len(model.points_world):,} points "
        f"were triangulated from the photographs with the cameras held fixed{from_cloud}, observed "
        f"{len(model.observation_point):,} times; median reprojection error "
        f"{float(observation_errors(model).median()):.2f} px.",
        stacklevel=3,
    )
    return model


# Least fraction of inliers, and that of reliable cameras. Correct cameras have 0.97 to 1.00 at 2 px
# in five scenes (the skull, three rendered ones of 240 to 400 px, a ball in closed form). Cameras
# of a mirrored relief have up to 0.83 along an arc.
_MIN_AGREEMENT, _RELIABLE = 0.5, 0.9


def require_agreement(
    model: SparseModel, verified: Sequence[matching.VerifiedPair], max_error_px: float, where: str
) -> None:
    """Refuse cameras with too few inliers among the matches, and warn of unreliable ones.

    Inliers of a pair's own epipolar geometry are found without the cameras. With correct cameras
    most of them are on these cameras' epipolar lines and in front of both; with wrong ones a few
    are by chance.

    Raises:
        InputError: Fewer than half of the matches are inliers.
    """
    total = sum(pair.num_matches for pair in verified)
    pairs, cameras = epipolar.undistorted_pairs(model, verified), pinholes_of(model)
    consistent = sum(int(epipolar.inliers(cameras, pair, max_error_px).sum()) for pair in pairs)
    if total < 2 * MIN_MATCHES or consistent >= _RELIABLE * total:
        return
    finding = (
        f"{consistent / total:.0%} of {total} matches in {len(verified)} pairs of photographs are "
        f"within {max_error_px:g} px of the cameras' epipolar lines and in front of both cameras"
    )
    advice = (
        "Needed are cam_from_world, not its inverse, with camera axes x right, y down, z forward, "
        "and the names, order, sizes and lens of these photographs, resized at most; or omit the "
        "cameras to find them by structure from motion."
    )
    if consistent < _MIN_AGREEMENT * total:
        raise InputError(
            f"{where}: these cameras and the photographs do not belong together: {finding}; "
            f"needed: at least {_MIN_AGREEMENT:.0%}. {advice}"
        )
    caution(f"{where}: its cameras are unreliable: {finding}. {advice}", stacklevel=4)


def _match_along_lines(
    space: features.Workspace,
    model: SparseModel,
    verified: Sequence[matching.VerifiedPair],
    settings: ReconstructConfig,
) -> None:
    """Replace verified matches by matches along the cameras' epipolar lines."""
    cameras, limit = pinholes_of(model), settings.max_error_px
    # Pairs are chosen by inliers of the cameras, then by the angle between their axes.
    axes = model.cam_from_world[:, 2, :3]
    angles = torch.rad2deg((axes @ axes.mT).clamp(-1, 1).acos())
    weights = {
        (first, second): 1 - float(angles[first, second]) / 60
        for first, second in combinations(range(model.num_views), 2)
        if float(angles[first, second]) < 60  # degrees; beyond, hardly any feature matches
    }
    for checked in epipolar.undistorted_pairs(model, verified):
        if count := int(epipolar.inliers(cameras, checked, limit).sum()):
            weights[checked.views] = weights.get(checked.views, 0.0) + count
    pairs = matching.strongest(weights, model.num_views, max(settings.guided_pairs, 1))
    with quiet(), loaded().Database.open(space.database) as database:
        image_of = features.image_ids(database, space)
        detected = [matching.read_features(database, image) for image in image_of]
        undistorted = [
            x.replace(pixels=epipolar.undistorted_pixels(model, view, x.pixels))
            for view, x in enumerate(detected)
        ]

        def matches(pair: matching.PhotographPair) -> Tensor:
            first, second = (undistorted[number] for number in pair)
            if not len(first.pixels) or not len(second.pixels):
                return torch.zeros(0, 2, dtype=torch.long)
            near = matching.Near(epipolar.epipolar_geometry(cameras, pair), limit)
            rows = matching.guided_matches(first, second, near, settings.max_ratio)
            ends = matching.VerifiedPair(
                views=pair, first=first.pixels[rows[:, 0]], second=second.pixels[rows[:, 1]]
            )
            return rows[epipolar.inliers(cameras, ends, limit)]

        database.clear_two_view_geometries()
        for pair, rows in zip(pairs, side_by_side(matches, pairs), strict=True):
            geometry = loaded().TwoViewGeometry()
            geometry.config = loaded().TwoViewGeometryConfiguration.CALIBRATED
            geometry.F = epipolar.epipolar_geometry(cameras, pair).numpy()
            geometry.inlier_matches = rows.numpy().astype(np.uint32)
            database.write_two_view_geometry(*(image_of[number] for number in pair), geometry)


def _triangulated(space: features.Workspace, model: SparseModel, seed: int) -> SparseModel:
    pycolmap = loaded()
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.random_seed = seed
    options.triangulation.random_seed = seed
    options.extract_colors = False
    options.ba_refine_focal_length = False
    options.ba_refine_extra_params = False
    lenses = tuple(lens.replace(camera=view + 1) for view, lens in enumerate(model.lenses))
    bare = SparseModel(names=space.files, lenses=lenses, cam_from_world=model.cam_from_world)
    with tempfile.TemporaryDirectory(dir=space.folder) as output, quiet():
        cameras = reconstruction_of(bare)
        with pycolmap.Database.open(space.database) as stored:
            for camera in cameras.cameras.values():
                stored.update_camera(camera)
        reconstruction = pycolmap.triangulate_points(
            cameras, space.database, space.images, output, True, options
        )
    return model_of(reconstruction)


def _warn_of_no_points(count: int, where: str) -> None:
    caution(
        f"{where}: hardly any of its views observes points, and {count} could be "
        "triangulated from features, which hardly match between the photographs.",
        stacklevel=4,
    )
