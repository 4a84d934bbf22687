"""Settings of structure from motion."""

from dataclasses import dataclass
from typing import Annotated

from pimper_torch.runtime.config import Range, require, require_ranges
from pimper_torch.runtime.cores import usable_cores

# Verified matches below which a pair of photographs does not count, and points of the model that a
# view must see to be added, and to stay in it: COLMAP's own.
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
"""COLMAP's camera models for ordinary lenses, written out to check settings without COLMAP."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReconstructConfig:
    """Settings of structure from motion.

    Attributes:
        camera_model: COLMAP's name of the lens model.
        shared_camera: One camera took all photographs, with one lens at one focal length, whatever
            EXIF says. By default lenses are told apart by EXIF's focal length and by size.
        own_cameras: Each photograph has a lens of its own.
        peak_threshold: Contrast below which a feature is dropped; in COLMAP's units, where
            its own default is 0.0067. Lower finds the faint marks of smooth surfaces.
        edge_threshold: Ratio of curvatures above which a feature counts as an edge.
        max_features: In a photograph; those at coarse scales are kept, whole scales at a time, so
            that up to twice as many are left.
        affine_shape: Adapt features to slanted surfaces.
        max_ratio: Of the distances to the best and the second best match.
        guided_pairs: Of each photograph, those with most matches, in which more are looked for
            along the epipolar lines.
        max_error_px: Distance from the epipolar line up to which a match is verified.
        starts: Most runs of the mapper after guided matching of more pairs, where photographs
            stayed unregistered or contradict their matches; each has other random numbers, and
            the last also counts points that only two views see. 0 is content with the first
            model.
        track_iterations: Of finding the points again in every view, by aligning what photographs
            show round them, and adjusting cameras to that; 0 leaves the features' places.
        threads: Of features and matches; 0 for all cores. The model grows and is adjusted on one
            thread: on several, Ceres adds in another order in every run.
        seed: Of everything random.
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
        known = "one of " + ", ".join(CAMERA_MODELS)
        require(self.camera_model in CAMERA_MODELS, "camera_model", self.camera_model, known)
        both = self.shared_camera and self.own_cameras
        require(not both, "own_cameras", self.own_cameras, "false where shared_camera is true")
        require_ranges(self)

    @property
    def num_threads(self) -> int:
        """Threads of features and matches, at least 1."""
        return self.threads or usable_cores()
