"""Structure from motion: photographs to cameras and a sparse cloud."""

import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import nn

from pimper_torch.config import require
from pimper_torch.errors import InputError, PimperWarning, ReconstructionError
from pimper_torch.progress import track
from pimper_torch.records import SparseScene, Views
from pimper_torch.sfm import colmap
from pimper_torch.sfm.components import choose_component
from pimper_torch.sfm.model import (
    SparseModel,
    drop_weak_views,
    list_some,
    match_names,
    select_views,
)
from pimper_torch.sfm.photographs import write_photographs
from pimper_torch.sfm.refine_tracks import TrackSettings, refine_tracks
from pimper_torch.sfm.scene import assemble_scene


@dataclass(frozen=True, slots=True, kw_only=True)
class ReconstructConfig:
    """Settings of structure from motion.

    Attributes:
        camera_model: COLMAP's name of the lens model.
        shared_camera: One camera took all photographs, with one lens at one focal length.
        peak_threshold: Contrast below which a feature is dropped; in COLMAP's units, where
            its own default is 0.0067. Lower finds the faint marks of smooth surfaces.
        edge_threshold: Ratio of curvatures above which a feature counts as an edge.
        max_features: Most features in a photograph; those at coarse scales are kept.
        affine_shape: Adapt features to slanted surfaces.
        domain_size_pooling: Average descriptors over scales.
        max_ratio: Of the distances to the best and the second best match.
        guided_matching: Look for more matches along the epipolar lines.
        max_error_px: Distance from the epipolar line up to which a match is verified.
        min_matches: Verified matches below which a pair of photographs does not count.
        min_registration_points: Points of the model that a view must see to be added, and
            to stay in it.
        starts: Most runs of the mapper, each with other random numbers; the first that
            registers every view ends them. Else the one with most views, then most points,
            is kept, after one more run that also counts points that only two views see.
        min_share: Of the photographs that the largest component must hold when the model
            splits.
        track_rounds: Of finding the points again in every view, by aligning what photographs
            show round them, and adjusting cameras to that; 0 leaves the features' places.
        threads: 0 for all cores. With 1 the result is the same bit for bit.
        seed: Of everything random.
    """

    camera_model: str = "SIMPLE_RADIAL"
    shared_camera: bool = True
    peak_threshold: float = 0.002
    edge_threshold: float = 10.0
    max_features: int = 8192
    affine_shape: bool = True
    domain_size_pooling: bool = False
    max_ratio: float = 0.8
    guided_matching: bool = True
    max_error_px: float = 2.0
    min_matches: int = 15
    min_registration_points: int = 30
    starts: int = 3
    min_share: float = 0.6
    track_rounds: int = 2
    threads: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        require(
            self.camera_model in colmap.CAMERA_MODELS,
            "camera_model",
            self.camera_model,
            "one of " + ", ".join(colmap.CAMERA_MODELS),
        )
        require(self.peak_threshold > 0, "peak_threshold", self.peak_threshold, "more than 0")
        require(self.edge_threshold > 0, "edge_threshold", self.edge_threshold, "more than 0")
        require(self.max_features >= 8, "max_features", self.max_features, "at least 8")
        require(0 < self.max_ratio <= 1, "max_ratio", self.max_ratio, "in (0, 1]")
        require(self.max_error_px > 0, "max_error_px", self.max_error_px, "more than 0")
        require(self.min_matches >= 8, "min_matches", self.min_matches, "at least 8")
        require(
            self.min_registration_points >= 6,
            "min_registration_points",
            self.min_registration_points,
            "at least 6",
        )
        require(self.starts >= 1, "starts", self.starts, "at least 1")
        require(0 < self.min_share <= 1, "min_share", self.min_share, "in (0, 1]")
        require(self.track_rounds >= 0, "track_rounds", self.track_rounds, "0 or more")
        require(self.threads >= 0, "threads", self.threads, "0 for all cores, or a number of them")
        require(self.seed >= 0, "seed", self.seed, "0 or more")


class Reconstruct(nn.Module):
    """Find cameras and a sparse cloud, and undistort the photographs to pinholes.

    The photographs are written as 8-bit sRGB files to a temporary folder, where COLMAP
    finds SIFT features on the CPU, matches every pair and grows a model. Its points are then
    found again in all views by aligning patches, and everything is adjusted to that, see
    :func:`~pimper_torch.sfm.refine_tracks.refine_tracks`. The world frame and its scale are
    whatever the model comes in.

    A constant to autograd.
    """

    def __init__(self, config: ReconstructConfig | None = None) -> None:
        super().__init__()
        self.config = config or ReconstructConfig()

    def forward(self, views: Views, sparse_model: Path | str | None = None) -> SparseScene:
        """Place the photographs.

        Args:
            views: At least 3.
            sparse_model: Folder of a COLMAP model to take instead of running structure
                from motion. Views are matched by file name; the model's cameras may have
                been made from photographs of another size.

        Raises:
            ReconstructionError: Fewer than 3 views found their place, or the model split.
            InputError: Radiance that is not finite, one camera is to be shared by photographs
                of unlike sizes, or the given model does not belong to the photographs.
        """
        _require_finite(views)
        if sparse_model is None:
            model = self._structure_from_motion(views)
        else:
            model = self._existing_model(views, Path(sparse_model))
        missing = [name for name in views.names if name not in model.names]
        if missing:
            warnings.warn(
                f"{model.num_views} of {views.num_views} photographs found their place; left "
                f"out: {', '.join(missing)}.",
                PimperWarning,
                stacklevel=2,
            )
        return assemble_scene(views, model)

    def _existing_model(self, views: Views, folder: Path) -> SparseModel:
        model = match_names(colmap.read_model(folder), views.names, folder)
        if model.num_views < 3:
            raise ReconstructionError(
                f"The COLMAP model in {folder} holds {model.num_views} of {views.num_views} "
                f"photographs ({', '.join(model.names)}); at least 3 are needed. Use a model that "
                "holds more of them, or leave it out to run structure from motion."
            )
        return _follow_resize(model, views)

    def _structure_from_motion(self, views: Views) -> SparseModel:
        config = self.config
        if views.num_views < 3:
            raise ReconstructionError(
                f"Structure from motion was given {views.num_views} photographs; at least 3 are "
                "needed, and 10 to 50 are usual. Add photographs from other viewpoints."
            )
        if config.shared_camera:
            _require_one_size(views)
        with tempfile.TemporaryDirectory(prefix="pimper_") as folder:
            place = Path(folder)
            files = self._find_features(views, place)
            self._match(place)
            models = self._map(place, views.num_views)
        names = dict(zip(files, views.names, strict=True))
        models = [
            model.replace(names=tuple(names[file] for file in model.names)) for model in models
        ]
        parts = [model.names for model in models]
        model = models[choose_component(parts, views.names, config.min_share)]
        placed = [model.names.index(name) for name in views.names if name in model.names]
        model = select_views(model, placed)
        return refine_tracks(
            views.take([views.names.index(name) for name in model.names]),
            model,
            TrackSettings(
                rounds=config.track_rounds,
                fewest_points=config.min_registration_points,
                threads=config.threads or -1,
            ),
        )

    def _find_features(self, views: Views, place: Path) -> tuple[str, ...]:
        config = self.config
        images, masks, database = place / "images", place / "masks", place / "database.db"
        images.mkdir()
        masks.mkdir()
        files = write_photographs(views, images, masks)
        settings = colmap.FeatureSettings(
            peak_threshold=config.peak_threshold,
            edge_threshold=config.edge_threshold,
            max_features=config.max_features,
            affine_shape=config.affine_shape,
            domain_size_pooling=config.domain_size_pooling,
            threads=config.threads or -1,
        )
        counts = colmap.extract_features(
            database,
            images,
            None if views.masks is None else masks,
            files,
            camera_model=config.camera_model,
            shared_camera=config.shared_camera,
            settings=settings,
        )
        _require_features(counts, views.names)
        known = {
            file: float(focal)
            for file, focal in zip(files, views.focals_px, strict=True)
            if torch.isfinite(focal) and focal > 0
        }
        colmap.set_focals(database, known)
        return files

    def _match(self, place: Path) -> None:
        config = self.config
        settings = colmap.MatchSettings(
            max_ratio=config.max_ratio,
            guided=config.guided_matching,
            max_error_px=config.max_error_px,
            min_inliers=config.min_matches,
            seed=config.seed,
            threads=config.threads or -1,
        )
        colmap.match_features(place / "database.db", settings)

    def _map(self, place: Path, num_views: int) -> list[SparseModel]:
        best: list[SparseModel] = []
        for start in track(range(self.config.starts)):
            best = max(best, self._map_once(place, start, pairs=False), key=_most)
            if _most(best)[0] == num_views:
                break
        else:
            # Points of two views make poses less exact where all views register without them:
            # median error 0.19 instead of 0.13 degrees on 24 photographs of a skull.
            tied = self._map_once(place, 0, pairs=True)
            best = tied if _most(tied)[0] > _most(best)[0] else best
        return best

    def _map_once(self, place: Path, start: int, *, pairs: bool) -> list[SparseModel]:
        config = self.config
        settings = colmap.MapSettings(
            min_inliers=config.min_registration_points,
            pairs_count=pairs,
            seed=config.seed + start,
            threads=config.threads or -1,
        )
        found = colmap.map_views(place / "database.db", place / "images", settings)
        return [drop_weak_views(model, config.min_registration_points) for model in found]


def _most(models: Sequence[SparseModel]) -> tuple[int, int]:
    sizes = [(model.num_views, len(model.points_world)) for model in models]
    return max(sizes, default=(0, 0))


def _follow_resize(model: SparseModel, views: Views) -> SparseModel:
    sizes = dict(zip(views.names, views.sizes_px.tolist(), strict=True))
    lenses, scales = [], []
    cameras: dict[tuple[int, int, int], int] = {}
    fresh = 1 + max(lens.camera for lens in model.lenses)
    for name, lens in zip(model.names, model.lenses, strict=True):
        width, height = sizes[name]
        scale = width / lens.width, height / lens.height
        # Rounding a side to whole pixels changes the shape by less than this.
        if abs(scale[0] / scale[1] - 1) > max(0.01, 2 / min(width, height)):
            raise InputError(
                f"{name} is {width}x{height}, but the COLMAP model's camera for it is "
                f"{lens.width}x{lens.height}, which is another shape. Give the photographs the "
                "model was made from, resized if you like, but neither cropped nor turned."
            )
        # Photographs of one camera that were resized differently no longer share it; the
        # first of them keep its number.
        known = {number for number, *_ in cameras}
        if lens.camera not in known:
            cameras[lens.camera, width, height] = lens.camera
        camera = cameras.setdefault((lens.camera, width, height), fresh + len(cameras))
        lenses.append(colmap.rescale_lens(lens, width, height).replace(camera=camera))
        scales.append(scale)
    factors = torch.tensor(scales, dtype=torch.float64)
    return model.replace(
        lenses=tuple(lenses),
        observation_pixels=model.observation_pixels * factors[model.observation_view],
    )


def _require_finite(views: Views) -> None:
    """Refuse pixels that are no numbers, which resampling would spread over their neighbours."""
    odd = [
        f"{name} ({int((~image.isfinite()).any(dim=0).sum())} pixels)"
        for name, image in zip(views.names, views.images, strict=True)
        if not bool(image.isfinite().all())
    ]
    if odd:
        raise InputError(
            f"NaN or infinity in the photographs {', '.join(odd)}; needed: radiance in numbers. "
            "Set these pixels to 0 and leave them out by `masks`, or to 1 if they are saturated."
        )


def _require_one_size(views: Views) -> None:
    sizes = [(width, height) for width, height in views.sizes_px.tolist()]
    groups = {
        size: [name for name, its in zip(views.names, sizes, strict=True) if its == size]
        for size in dict.fromkeys(sizes)
    }
    if len(groups) > 1:
        found = "; ".join(
            f"{width}x{height}: {list_some(names)}" for (width, height), names in groups.items()
        )
        raise InputError(
            f"One shared camera was asked for, but the photographs have {len(groups)} sizes "
            f"({found}). Give each its own camera with `--reconstruct.no-shared-camera` "
            "(`shared_camera: false` in YAML), or photographs of one size."
        )


def _require_features(counts: Sequence[int], names: Sequence[str]) -> None:
    bare = [name for count, name in zip(counts, names, strict=True) if count == 0]
    if len(names) - len(bare) < 3:
        raise ReconstructionError(
            f"No features were found in {len(bare)} of {len(names)} photographs: "
            f"{list_some(bare, most=20)}. At least 3 photographs with features are needed. Check "
            "that they are not black, blank or masked out entirely, and expose them brighter."
        )
