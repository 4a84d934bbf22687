"""Structure from motion: photographs to cameras and a sparse cloud."""

from dataclasses import replace
from pathlib import Path

import torch

from pimper_torch.method.sfm.diagnose import choose_component, diagnose
from pimper_torch.method.sfm.existing import existing_model, registered_views, source_label
from pimper_torch.method.sfm.features import SMALLEST_PX, find_features, too_small, workspace
from pimper_torch.method.sfm.lenses import choose_lenses
from pimper_torch.method.sfm.model import SparseModel, select_views
from pimper_torch.method.sfm.moved_object import series_in, with_series
from pimper_torch.method.sfm.poses import of_photographs, pictures_of_poses
from pimper_torch.method.sfm.reconstruct_config import ReconstructConfig
from pimper_torch.method.sfm.refine_tracks import refine_tracks
from pimper_torch.method.sfm.registration import register
from pimper_torch.method.sfm.sparse_scene import assemble_scene, model_of_scene, with_model_points
from pimper_torch.method.sfm.triangulation import lacks_points, triangulate
from pimper_torch.method.sfm.upright import upright
from pimper_torch.records import SparseScene, Views
from pimper_torch.runtime.errors import InputError, ReconstructionError, caution, some
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.mapped import each
from pimper_torch.runtime.memory import release_memory
from pimper_torch.runtime.stage import Stage
from pimper_torch.runtime.store import Store, digest, kept, opened
from pimper_torch.runtime.store.digest import code


class Reconstruct(Stage):
    """Find cameras and a sparse cloud, and undistort the photographs to pinholes.

    The photographs are written as 8-bit sRGB files to a temporary folder, where COLMAP
    finds SIFT features on the CPU, matches every pair and grows a model. Its points are then
    found again in all views by aligning patches, and everything is adjusted to that, see
    :func:`~pimper_torch.method.sfm.refine_tracks.refine_tracks`. In the world frame y is up, see
    :func:`~pimper_torch.method.sfm.upright.upright`; its scale is arbitrary. A model that is given
    keeps its own.

    A constant to autograd.

    Args:
        cache: Folder where models are kept and looked for, see
            :class:`~pimper_torch.runtime.store.Store`; without, every call finds its own.
    """

    def __init__(
        self, config: ReconstructConfig | None = None, cache: Store | Path | str | None = None
    ) -> None:
        super().__init__()
        self.config = config or ReconstructConfig()
        self.store = opened(cache)

    def forward(self, views: Views, sparse_model: Path | str | None = None) -> SparseScene:
        """Place the photographs.

        Args:
            sparse_model: Folder of a COLMAP model, or a file of cameras (``transforms.json``,
                Metashape, Meshroom, arrays), to take instead of running structure from motion.
                Views are matched by file name; the cameras may have been made from photographs of
                another size. Without observed points, these are triangulated with the cameras
                held fixed.

        Raises:
            ReconstructionError: Fewer than 3 views found their place, or the model split.
            InputError: Radiance that is not finite, one camera is to be shared by photographs
                of unlike sizes, or the given model does not belong to the photographs.
        """
        _require_finite(views)
        bare = views.replace(priors=())  # which tell nothing of where cameras stand
        if sparse_model is None:
            model, _ = find_model(pictures_of_poses(bare), self.config, self.store)
            return placed_scene(views, of_photographs(model, views))
        path = Path(sparse_model)
        model = existing_model(bare, path)
        if lacks_points(model):
            model = self._triangulated(registered_views(bare, model), model, source_label(path))
        return placed_scene(views, model)

    def with_points(self, scene: SparseScene) -> SparseScene:
        """Triangulate points for a scene whose views observe hardly any, its cameras held fixed."""
        model = model_of_scene(scene)
        if not lacks_points(model) or not scene.lenses:
            return scene
        found = self._triangulated(scene.views.replace(priors=()), model, "The scene")
        return scene if found is model else with_model_points(scene, found)

    def _triangulated(self, views: Views, model: SparseModel, where: str) -> SparseModel:
        alone = replace(self.config, threads=0)
        hashed = digest(code(), views, model, alone) if self.store else None
        key = f"triangulate-{hashed}" if hashed else None
        return kept(
            self.store, key, SparseModel, lambda: triangulate(views, model, self.config, where)
        )[0]


def placed_scene(views: Views, model: SparseModel) -> SparseScene:
    """Put photographs beside their cameras and cloud.

    Warns of those that the model lacks, and of a model that is doubtful.
    """
    missing = [name for name in views.names if name not in model.names]
    leave_out("sfm.missing", len(missing), total=views.num_views, names=missing)
    if missing:
        caution(
            f"{model.num_views} of {views.num_views} photographs found their place; left "
            f"out: {', '.join(missing)}.",
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
    """Take a model that was kept, or run :func:`structure_from_motion` and keep what it finds.

    The number of threads is no part of the key. What was warned of is warned of again.

    Returns:
        The model, and the seconds of wall clock in which it was found.
    """
    hashed = digest(code(), views, replace(config, threads=0)) if store else None
    key = f"reconstruct-{hashed}" if hashed else None
    return kept(store, key, SparseModel, lambda: structure_from_motion(views, config))


def structure_from_motion(views: Views, config: ReconstructConfig) -> SparseModel:
    """Find features, match them, grow a model and find its points again in every view.

    Returns:
        The model of the registered views, in the photographs' order and under their names.

    Raises:
        ReconstructionError: Fewer than 3 views found their place, the model split, or nothing
            moves from photograph to photograph.
        InputError: One camera is to be shared by photographs of unlike sizes, or photographs are
            too small to have features.
    """
    if views.num_views < 3:
        raise ReconstructionError(
            f"Structure from motion was given {views.num_views} photographs; at least 3 are "
            "needed, and 10 to 50 are usual. Add photographs from other viewpoints."
        )
    if small := too_small(views):
        raise InputError(
            f"{some(small)}: have sides of fewer than {SMALLEST_PX} pixels; needed: photographs "
            "in which there are features, of some hundred pixels at least."
        )
    model = _registered_model(views, config)
    model = refine_tracks(registered_views(views, model), model, config.track_iterations)
    release_memory()
    return upright(model)


def _registered_model(views: Views, config: ReconstructConfig) -> SparseModel:
    """Grow models of photographs, and choose one.

    Its views are in the photographs' order, with maps to a room at rest and numbers of series.
    """
    lenses = choose_lenses(views, shared=config.shared_camera, own=config.own_cameras)
    focals_px = [one if 0 < one < float("inf") else None for one in views.focals_px.tolist()]
    release_memory()  # that reading the photographs left: 145 MB with 30 of 1600x1200
    with workspace(views, config.num_threads) as space:
        counts = find_features(space, config, focals_px, lenses)
        bare = [name for count, name in zip(counts, views.names, strict=True) if count == 0]
        if views.num_views - len(bare) < 3:
            raise ReconstructionError(
                f"No features were found in {len(bare)} of {views.num_views} photographs: "
                f"{some(bare, most=20)}. At least 3 photographs with features are needed. Check "
                "that they are not black, blank or masked out entirely, and expose them brighter."
            )
        release_memory()
        found = register(space, config)
    release_memory()
    # The largest of several models must hold most photographs, if they are not of several series.
    min_fraction = 0.0 if found.around else 0.6
    name_of = dict(zip(space.files, views.names, strict=True))
    names = [tuple(name_of[file] for file in model.names) for model in found.models]
    chosen = choose_component(names, found.spread, views.names, min_fraction)
    model = found.models[chosen]
    order = sorted(range(model.num_views), key=model.names.__getitem__)  # files are numbered
    model = select_views(model.replace(names=names[chosen]), order)
    misplaced = [
        f"{name_of[file]} ({fraction:.0%} agree)"
        for file, fraction in found.misplaced.items()
        if name_of[file] in model.names
    ]
    leave_out("sfm.misplaced", len(misplaced), total=model.num_views)
    if misplaced:
        caution(
            f"{len(misplaced)} of {model.num_views} photographs contradict most matches with those "
            f"they share most with, and may be misplaced: {some(misplaced, most=20)}. Look "
            "for sides that look alike; add photographs between these and their neighbours.",
            stacklevel=4,
        )
    if found.background:
        maps = dict(zip(views.names, found.background, strict=True))
        rests = torch.stack([maps[name] for name in model.names])
        model = model.replace(background_from_view=rests)
    if found.around:
        model = with_series(model, series_in(model, views.names, found.around), views.names)
    return model


def _require_finite(views: Views) -> None:
    """Refuse pixels that are no numbers, which resampling would spread over their neighbours."""
    odd = [
        f"{name} ({int((~image.isfinite()).any(dim=0).sum())} pixels)"
        for name, (image,) in zip(views.names, each(views.images), strict=True)
        if not bool(image.isfinite().all())
    ]
    if odd:
        raise InputError(
            f"NaN or infinity in the photographs {', '.join(odd)}; needed: radiance in numbers. "
            "Set these pixels to 0 and leave them out by `masks`, or to 1 if they are saturated."
        )
