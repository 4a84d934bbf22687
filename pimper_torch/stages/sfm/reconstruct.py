"""The stage from photographs to cameras and a sparse point cloud."""

from dataclasses import replace
from pathlib import Path

import torch

from pimper_torch.io.cameras.existing import existing_model, registered_views, source_label
from pimper_torch.records import SparseScene, Views
from pimper_torch.records.sparse_model import SparseModel, select_views
from pimper_torch.runtime.errors import InputError, ReconstructionError, caution, some
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.mapped import each
from pimper_torch.runtime.memory import release_memory
from pimper_torch.stages.sfm.diagnose import choose_component, diagnose
from pimper_torch.stages.sfm.features import SMALLEST_PX, find_features, too_small, workspace
from pimper_torch.stages.sfm.lenses import choose_lenses
from pimper_torch.stages.sfm.moved_object import sessions_in, with_sessions
from pimper_torch.stages.sfm.poses import expand_to_photographs, mean_images
from pimper_torch.stages.sfm.reconstruct_config import ReconstructConfig
from pimper_torch.stages.sfm.refine_tracks import refine_tracks
from pimper_torch.stages.sfm.registration import register_photographs
from pimper_torch.stages.sfm.sparse_scene import assemble_scene, model_of_scene, with_model_points
from pimper_torch.stages.sfm.triangulation import lacks_points, triangulate
from pimper_torch.stages.sfm.upright import rotate_upright
from pimper_torch.stages.stage import Stage
from pimper_torch.store import Store, digest, kept, opened
from pimper_torch.store.digest import code


class Reconstruct(Stage):
    """Estimate cameras and a sparse cloud, and undistort the photographs to pinholes.

    The photographs are written as 8-bit sRGB files to a temporary folder, where COLMAP detects SIFT
    features on the CPU, matches pairs and maps. Points are then refined in all views by aligning
    patches, and cameras and points are adjusted again, see
    :func:`~pimper_torch.stages.sfm.refine_tracks.refine_tracks`. In the world frame y is up, see
    :func:`~pimper_torch.stages.sfm.upright.rotate_upright`; its scale is arbitrary. A given model
    keeps its frame and scale.

    Not differentiable.

    Args:
        cache: Folder of kept models, see :class:`~pimper_torch.store.Store`; without it,
            every call estimates a model.
    """

    def __init__(
        self, config: ReconstructConfig | None = None, cache: Store | Path | str | None = None
    ) -> None:
        super().__init__()
        self.config = config or ReconstructConfig()
        self.store = opened(cache)

    def forward(self, views: Views, sparse_model: Path | str | None = None) -> SparseScene:
        """Estimate or read the photographs' cameras, and return the scene.

        Args:
            sparse_model: Folder of a COLMAP model, or a camera file (``transforms.json``,
                Metashape, Meshroom, arrays), instead of structure from motion. Views are matched by
                file name; the cameras may be of images of a different size. Without observed
                points, these are triangulated with the cameras held fixed.

        Raises:
            ReconstructionError: Fewer than 3 views registered, or the model split.
            InputError: Radiance is not finite, photographs of one shared camera have different
                sizes, or the given model does not belong to the photographs.
        """
        _require_finite(views)
        bare = views.replace(priors=())  # priors do not affect cameras
        if sparse_model is None:
            model, _ = find_model(mean_images(bare), self.config, self.store)
            return placed_scene(views, expand_to_photographs(model, views))
        path = Path(sparse_model)
        model = existing_model(bare, path)
        if lacks_points(model):
            model = self._triangulated(registered_views(bare, model), model, source_label(path))
        return placed_scene(views, model).replace(given=True)

    def with_points(self, scene: SparseScene) -> SparseScene:
        """Triangulate points for a scene with hardly any observations, its cameras held fixed."""
        model = model_of_scene(scene)
        if not lacks_points(model) or not scene.lenses:
            return scene
        result = self._triangulated(scene.views.replace(priors=()), model, "The scene")
        return scene if result is model else with_model_points(scene, result)

    def _triangulated(self, views: Views, model: SparseModel, where: str) -> SparseModel:
        alone = replace(self.config, threads=0)
        hashed = digest(code(), views, model, alone) if self.store else None
        key = f"triangulate-{hashed}" if hashed else None
        return kept(
            self.store, key, SparseModel, lambda: triangulate(views, model, self.config, where)
        )[0]


def placed_scene(views: Views, model: SparseModel) -> SparseScene:
    """Return the scene of photographs, cameras and cloud.

    Warns about unregistered photographs, and about an unreliable model.
    """
    missing = [name for name in views.names if name not in model.names]
    leave_out("sfm.missing", len(missing), total=views.num_views, names=missing)
    if missing:
        caution(
            f"{model.num_views} of {views.num_views} photographs were registered; excluded: "
            f"{', '.join(missing)}.",
            stacklevel=3,
        )
    reason = "" if lacks_points(model) else diagnose(model, views.num_views)
    leave_out("sfm.diagnosis", bool(reason))
    if reason:
        caution(reason, stacklevel=3)
    return assemble_scene(views, model).replace(diagnosis=reason)


def find_model(
    views: Views, config: ReconstructConfig, store: Store | None
) -> tuple[SparseModel, float]:
    """Return a kept model, or run :func:`structure_from_motion` and keep its result.

    The number of threads is not part of the key. Warnings are repeated.

    Returns:
        The model, and the seconds of wall clock that its estimation took.
    """
    hashed = digest(code(), views, replace(config, threads=0)) if store else None
    key = f"reconstruct-{hashed}" if hashed else None
    return kept(store, key, SparseModel, lambda: structure_from_motion(views, config))


def structure_from_motion(views: Views, config: ReconstructConfig) -> SparseModel:
    """Detect features, match them, map, and refine the points in every view.

    Returns:
        The model of the registered views, in the photographs' order and with their names.

    Raises:
        ReconstructionError: Fewer than 3 views registered, the model split, or nothing moves
            between photographs.
        InputError: Photographs of one shared camera have different sizes, or photographs are too
            small for features.
    """
    if views.num_views < 3:
        raise ReconstructionError(
            f"Structure from motion was given {views.num_views} photographs; at least 3 are "
            "needed, and 10 to 50 are usual. Add photographs from other viewpoints."
        )
    if small := too_small(views):
        raise InputError(
            f"{some(small)}: have sides of fewer than {SMALLEST_PX} pixels; needed: photographs "
            "with features, of at least some hundred pixels."
        )
    model = _registered_model(views, config)
    model = refine_tracks(registered_views(views, model), model, config.track_iterations)
    release_memory()
    return rotate_upright(model)


def _registered_model(views: Views, config: ReconstructConfig) -> SparseModel:
    """Map the photographs, and choose one model, with views in the photographs' order.

    It has maps to a static background and numbers of capture sessions, if any.
    """
    lenses = choose_lenses(views, shared=config.shared_camera, own=config.own_cameras)
    focals_px = [f if 0 < f < float("inf") else None for f in views.focals_px.tolist()]
    release_memory()  # from reading the photographs: 145 MB with 30 of 1600x1200
    with workspace(views, config.num_threads) as space:
        counts = find_features(space, config, focals_px, lenses)
        featureless = [name for count, name in zip(counts, views.names, strict=True) if count == 0]
        if views.num_views - len(featureless) < 3:
            raise ReconstructionError(
                f"No features were found in {len(featureless)} of {views.num_views} photographs: "
                f"{some(featureless, most=20)}. At least 3 photographs with features are needed. "
                "Check that they are not black, blank or fully masked out, and expose longer."
            )
        release_memory()
        result = register_photographs(space, config)
    release_memory()
    # The largest of several models must contain most photographs, unless there are sessions.
    min_fraction = 0.0 if result.around else 0.6
    name_of = dict(zip(space.files, views.names, strict=True))
    names = [tuple(name_of[file] for file in model.names) for model in result.models]
    chosen = choose_component(names, result.spread, views.names, min_fraction)
    model = result.models[chosen]
    order = sorted(range(model.num_views), key=model.names.__getitem__)  # files are numbered
    model = select_views(model.replace(names=names[chosen]), order)
    misplaced = [
        f"{name_of[file]} ({fraction:.0%} agree)"
        for file, fraction in result.misplaced.items()
        if name_of[file] in model.names
    ]
    leave_out("sfm.misplaced", len(misplaced), total=model.num_views)
    if misplaced:
        caution(
            f"{len(misplaced)} of {model.num_views} photographs contradict most matches with their "
            f"closest neighbours, and may be misplaced: {some(misplaced, most=20)}. Check for "
            "sides that look alike; add photographs between these and their neighbours.",
            stacklevel=4,
        )
    if result.background:
        maps = dict(zip(views.names, result.background, strict=True))
        background_from_view = torch.stack([maps[name] for name in model.names])
        model = model.replace(background_from_view=background_from_view)
    if result.around:
        model = with_sessions(model, sessions_in(model, views.names, result.around), views.names)
    return model


def _require_finite(views: Views) -> None:
    """Refuse NaN and infinity, which resampling would spread to neighbouring pixels."""
    odd = [
        f"{name} ({int((~image.isfinite()).any(dim=0).sum())} pixels)"
        for name, (image,) in zip(views.names, each(views.images), strict=True)
        if not bool(image.isfinite().all())
    ]
    if odd:
        raise InputError(
            f"NaN or infinity in the photographs {', '.join(odd)}; needed: finite radiance. Set "
            "these pixels to 0 and exclude them by `masks`, or to 1 if they are saturated."
        )
