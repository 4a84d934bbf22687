"""Settings of structure from motion."""

from dataclasses import dataclass
from typing import Annotated

from pimper_torch.runtime.config import Range, require, require_ranges
from pimper_torch.runtime.cores import usable_cores

# Least verified matches of a pair of photographs, and least points of the model in a view for
# registering and keeping it: COLMAP's own.
MIN_MATCHES, MIN_POINTS = 15, 30

CAMERA_MODELS = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "OPENCV_FISHEYE",
)
"""COLMAP's camera models for ordinary lenses, listed to check settings without COLMAP."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReconstructConfig:
    """Settings of structure from motion.

    Attributes:
        camera_model: COLMAP's name of the lens model.
        shared_camera: All photographs share one lens at one focal length, whatever EXIF contains.
            By default lenses are distinguished by EXIF's focal length and by size.
        own_cameras: Each photograph has its own lens.
        peak_threshold: Least contrast of a feature, in COLMAP's units, in which its own default is
            0.0067. A lower value finds faint marks on smooth surfaces.
        edge_threshold: Largest ratio of curvatures of a feature; above it is an edge.
        max_features: Per photograph. Coarse scales are preferred, in complete scales, so up to
            twice as many remain.
        affine_shape: Adapt features to slanted surfaces.
        max_ratio: Largest ratio of the distances to the best and the second-best match.
        guided_pairs: Number of pairs per photograph, those with most matches, that are matched
            again along the epipolar lines.
        max_error_px: Largest distance of a verified match from the epipolar line.
        starts: Most additional runs of the mapper, after guided matching of more pairs, if
            photographs are unregistered or contradict their matches. Runs differ in their random
            numbers; one more run also uses points of only two views. 0 accepts the first model.
        track_iterations: Rounds of refining points in every view by aligning the patches around
            them, and adjusting the cameras; 0 keeps the pixels of features.
        threads: For features and matches; 0 for all cores. Mapping and adjustment use one thread:
            with several, Ceres sums in a different order in every run.
        seed: Of all random numbers.
    """

    camera_model: str = "SIMPLE_RADIAL"
    shared_camera: bool = False
    own_cameras: bool = False
    peak_threshold: Annotated[float, Range(above=0, most=1)] = 0.002
    edge_threshold: Annotated[float, Range(above=0, most=1e6)] = 10.0
    max_features: Annotated[int, Range(least=8, most=65_536)] = 4096
    affine_shape: bool = True
    max_ratio: Annotated[float, Range(above=0, most=1)] = 0.8
    guided_pairs: Annotated[int, Range(least=0, most=100_000)] = 10
    max_error_px: Annotated[float, Range(above=0, most=1e6)] = 2.0
    starts: Annotated[int, Range(least=0, most=1000)] = 3
    track_iterations: Annotated[int, Range(least=0, most=1000)] = 2
    threads: Annotated[int, Range(least=0, most=1024)] = 0
    seed: Annotated[int, Range(least=0, most=2**31 - 1)] = 0

    def __post_init__(self) -> None:
        expected = "one of " + ", ".join(CAMERA_MODELS)
        require(self.camera_model in CAMERA_MODELS, "camera_model", self.camera_model, expected)
        valid = not (self.shared_camera and self.own_cameras)
        require(valid, "own_cameras", self.own_cameras, "false if shared_camera is true")
        require_ranges(self)

    @property
    def num_threads(self) -> int:
        """Threads of features and matches, at least 1."""
        return self.threads or usable_cores()
