"""COLMAP's structure from motion and its models of cameras.

Photographs go by their number here: the file ``000007.png`` is view 7.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from pimper_torch.errors import InputError, OutputError
from pimper_torch.records import Lens
from pimper_torch.sfm.binding import loaded, quiet
from pimper_torch.sfm.model import SparseModel


@dataclass(frozen=True, slots=True, kw_only=True)
class FeatureSettings:
    """What counts as a feature; the words are those of COLMAP's SIFT."""

    peak_threshold: float
    edge_threshold: float
    max_features: int
    affine_shape: bool
    domain_size_pooling: bool
    threads: int


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchSettings:
    """What counts as a match of two photographs."""

    max_ratio: float
    guided: bool
    max_error_px: float
    min_inliers: int
    seed: int
    threads: int


@dataclass(frozen=True, slots=True, kw_only=True)
class MapSettings:
    """How views are added to a model.

    Attributes:
        min_inliers: Points of the model that a new view must see.
        pairs_count: Points that only two views see take part, too: they tie views with
            little overlap, less exactly.
        seed: Of everything random.
        threads: -1 for all cores.
    """

    min_inliers: int
    pairs_count: bool
    seed: int
    threads: int


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


def extract_features(
    database: Path,
    images: Path,
    masks: Path | None,
    files: Sequence[str],
    *,
    camera_model: str,
    shared_camera: bool,
    settings: FeatureSettings,
) -> list[int]:
    """Find features on the CPU and put them in the database.

    Args:
        database: Made if it does not exist.
        images: Folder of 8-bit photographs.
        masks: Folder of masks, ``NAME.png`` beside ``NAME``; features lie where they are
            not black.
        files: Names in ``images``.
        camera_model: COLMAP's name.
        shared_camera: One camera for all photographs instead of one each.
        settings: What counts as a feature.

    Returns:
        How many features each file has.
    """
    pycolmap = loaded()

    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = settings.threads
    options.sift.peak_threshold = settings.peak_threshold
    options.sift.edge_threshold = settings.edge_threshold
    options.sift.max_num_features = settings.max_features
    options.sift.estimate_affine_shape = settings.affine_shape
    options.sift.domain_size_pooling = settings.domain_size_pooling
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = camera_model
    if masks is not None:
        reader.mask_path = str(masks)
    mode = pycolmap.CameraMode.SINGLE if shared_camera else pycolmap.CameraMode.PER_IMAGE
    with quiet():
        pycolmap.extract_features(
            database,
            images,
            list(files),
            camera_mode=mode,
            reader_options=reader,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        with pycolmap.Database.open(database) as stored:
            image_ids = {image.name: image.image_id for image in stored.read_all_images()}
            return [
                stored.num_keypoints_for_image(image_ids[file]) if file in image_ids else 0
                for file in files
            ]


def set_focals(database: Path, focals_px: dict[str, float]) -> None:
    """Tell COLMAP the focal lengths that are known before SfM.

    Args:
        database: With its images.
        focals_px: By file. A camera shared by several photographs gets their median.
    """
    pycolmap = loaded()

    with pycolmap.Database.open(database) as stored:
        known: dict[int, list[float]] = {}
        for image in stored.read_all_images():
            if image.name in focals_px:
                known.setdefault(image.camera_id, []).append(focals_px[image.name])
        for camera in stored.read_all_cameras():
            if camera.camera_id not in known:
                continue
            params = np.array(camera.params)
            params[list(camera.focal_length_idxs())] = np.median(known[camera.camera_id])
            camera.params = params
            camera.has_prior_focal_length = True
            stored.update_camera(camera)


def match_features(database: Path, settings: MatchSettings) -> None:
    """Match every photograph with every other and verify the matches."""
    pycolmap = loaded()

    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    options.num_threads = settings.threads
    options.guided_matching = settings.guided
    options.sift.max_ratio = settings.max_ratio
    verification = pycolmap.TwoViewGeometryOptions()
    verification.min_num_inliers = settings.min_inliers
    verification.ransac.max_error = settings.max_error_px
    verification.ransac.random_seed = settings.seed
    with quiet():
        pycolmap.match_exhaustive(
            database,
            matching_options=options,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )


def map_views(database: Path, images: Path, settings: MapSettings) -> list[SparseModel]:
    """Grow models from the best pair of views on, until no view can be added.

    Returns:
        One model a component, the one with most views first. Names are files of ``images``.
    """
    pycolmap = loaded()

    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 3
    options.extract_colors = False
    options.num_threads = settings.threads
    options.random_seed = settings.seed
    options.mapper.abs_pose_min_num_inliers = settings.min_inliers
    options.triangulation.ignore_two_view_tracks = not settings.pairs_count
    with tempfile.TemporaryDirectory(dir=database.parent) as output, quiet():
        found = pycolmap.incremental_mapping(database, images, output, options)
    models = [model_of(reconstruction) for reconstruction in found.values()]
    return sorted(models, key=lambda model: (-model.num_views, -len(model.points_world)))


def read_model(folder: Path) -> SparseModel:
    """Read a COLMAP model, text or binary.

    Args:
        folder: Holds ``cameras``, ``images`` and ``points3D``, each ``.txt`` or ``.bin``.

    Raises:
        InputError: The folder holds no model, or one that COLMAP cannot read.
    """
    pycolmap = loaded()

    parts = ("cameras", "images", "points3D")
    complete = any(
        all((folder / f"{part}{ending}").is_file() for part in parts) for ending in (".bin", ".txt")
    )
    if not complete:
        raise InputError(
            f"{folder} holds no COLMAP model: needed are cameras, images and points3D, all .bin "
            "or all .txt. Point to the folder that has them, often named sparse/0."
        )
    try:
        with quiet():
            reconstruction = pycolmap.Reconstruction(str(folder))
    except (ValueError, RuntimeError, IndexError) as error:
        raise InputError(
            f"The COLMAP model in {folder} cannot be read: {error}. Write it again with COLMAP's "
            "model_converter, or leave it out to run structure from motion."
        ) from error
    return model_of(reconstruction)


def write_binary(model: SparseModel, colors: UInt8[Tensor, "point 3"], folder: Path) -> None:
    """Write a model as COLMAP's binary files.

    Args:
        model: Any.
        colors: 8-bit RGB, one a point.
        folder: Made if it does not exist; files of those names in it are replaced.

    Raises:
        OutputError: The files cannot be written.
    """
    with quiet():
        reconstruction = reconstruction_of(model, colors)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            reconstruction.write_binary(str(folder))
        except (ValueError, RuntimeError, OSError) as error:
            raise OutputError(
                f"The sparse model cannot be written to {folder}: {error}. "
                "Choose a folder that exists and may be written."
            ) from error


def pinhole_of(lens: Lens) -> Float[Tensor, "3 3"]:
    """Give ``K`` with the lens's focal length and principal point, in float64."""
    return torch.from_numpy(np.array(_camera_of(lens).calibration_matrix(), dtype=np.float64))


def is_pinhole(lens: Lens) -> bool:
    """Tell whether the lens has no distortion."""
    return bool(_camera_of(lens).is_undistorted())


def distort(lens: Lens, rays_cam: Float[Tensor, "ray 3"]) -> Float[Tensor, "ray 2"]:
    """Find where the lens images directions, in pixels of the photograph.

    Args:
        lens: Any of COLMAP's perspective or fisheye models.
        rays_cam: Camera frame, any length.

    Returns:
        NaN for directions that the lens cannot image. A constant to autograd.
    """
    rays = np.ascontiguousarray(rays_cam.detach().cpu().double().numpy())
    pixels = np.array(_camera_of(lens).img_from_cam(rays), dtype=np.float64).reshape(-1, 2)
    return torch.from_numpy(pixels).to(rays_cam)


def undistort_pixels(lens: Lens, pixels: Float[Tensor, "pixel 2"]) -> Float[Tensor, "pixel 2"]:
    """Undo :func:`distort`: give ``(x, y)`` of the direction ``(x, y, 1)`` behind each pixel."""
    columns = np.ascontiguousarray(pixels.detach().cpu().double().numpy())
    found = np.array(_camera_of(lens).cam_from_img(columns), dtype=np.float64).reshape(-1, 2)
    return torch.from_numpy(found).to(pixels)


def rescale_lens(lens: Lens, width: int, height: int) -> Lens:
    """Follow a resize of the photograph."""
    camera = _camera_of(lens)
    camera.rescale(width, height)
    return Lens(
        camera=lens.camera,
        model=lens.model,
        params=tuple(float(value) for value in camera.params),
        width=width,
        height=height,
    )


def _camera_of(lens: Lens) -> Any:  # noqa: ANN401 - pycolmap has no types before it is loaded
    pycolmap = loaded()

    camera = pycolmap.Camera.create_from_model_name(
        lens.camera, lens.model, 1.0, lens.width, lens.height
    )
    camera.params = np.array(lens.params)
    return camera


def model_of(reconstruction: Any) -> SparseModel:  # noqa: ANN401 - see _camera_of
    """Read COLMAP's own model; views by their ids, points by theirs."""
    image_ids = sorted(reconstruction.reg_image_ids())
    number = {image_id: index for index, image_id in enumerate(image_ids)}
    images = [reconstruction.image(image_id) for image_id in image_ids]
    pixels = {
        image_id: [point.xy for point in image.points2D]
        for image_id, image in zip(image_ids, images, strict=True)
    }
    points, tracks, places = [], [], []
    for index, point_id in enumerate(sorted(reconstruction.point3D_ids())):
        point = reconstruction.point3D(point_id)
        points.append(point.xyz)
        for element in point.track.elements:
            tracks.append((index, number[element.image_id]))
            places.append(pixels[element.image_id][element.point2D_idx])
    track = torch.tensor(tracks, dtype=torch.long).reshape(-1, 2)
    poses = np.array([image.cam_from_world().matrix() for image in images]).reshape(-1, 3, 4)
    bottom = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(images), 1, 4))
    return SparseModel(
        names=tuple(image.name for image in images),
        lenses=tuple(_lens_of(reconstruction.camera(image.camera_id)) for image in images),
        cam_from_world=torch.from_numpy(np.concatenate([poses, bottom], axis=1)),
        points_world=torch.from_numpy(np.array(points, dtype=np.float64).reshape(-1, 3)),
        observation_point=track[:, 0],
        observation_view=track[:, 1],
        observation_pixels=torch.from_numpy(np.array(places, dtype=np.float64).reshape(-1, 2)),
    )


def _lens_of(camera: Any) -> Lens:  # noqa: ANN401 - see _camera_of
    return Lens(
        camera=int(camera.camera_id),
        model=str(camera.model_name),
        params=tuple(float(value) for value in camera.params),
        width=int(camera.width),
        height=int(camera.height),
    )


def reconstruction_of(model: SparseModel, colors: UInt8[Tensor, "point 3"]) -> Any:  # noqa: ANN401
    """Make COLMAP's own model; its ids keep the order of views and points."""
    pycolmap = loaded()

    reconstruction = pycolmap.Reconstruction()
    for lens in {lens.camera: lens for lens in model.lenses}.values():
        reconstruction.add_camera_with_trivial_rig(_camera_of(lens))
    view, pixels = model.observation_view.numpy(), model.observation_pixels.numpy()
    position = np.empty(len(view), dtype=np.int64)  # of each observation in its image
    for index, (name, lens) in enumerate(zip(model.names, model.lenses, strict=True)):
        here = np.flatnonzero(view == index)
        position[here] = np.arange(len(here))
        image = pycolmap.Image(
            name=name, keypoints=pixels[here], camera_id=lens.camera, image_id=index + 1
        )
        pose = pycolmap.Rigid3d(model.cam_from_world[index, :3].numpy())
        reconstruction.add_image_with_trivial_frame(image, pose)
    order = np.argsort(model.observation_point.numpy(), kind="stable")
    starts = np.searchsorted(
        model.observation_point.numpy()[order], np.arange(len(model.points_world) + 1)
    )
    rgb = colors.cpu().numpy()
    for index, xyz in enumerate(model.points_world.numpy()):
        track = pycolmap.Track()
        for observation in order[starts[index] : starts[index + 1]]:
            track.add_element(int(view[observation]) + 1, int(position[observation]))
        reconstruction.add_point3D(xyz, track, rgb[index])
    reconstruction.update_point_3d_errors()
    return reconstruction
