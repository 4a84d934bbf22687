"""SIFT features of photographs, found by COLMAP on the CPU."""

from collections.abc import Sequence
from itertools import groupby
from operator import itemgetter
from typing import Any

import numpy as np

from pimper_torch.progress import track
from pimper_torch.records import Views
from pimper_torch.sfm.binding import loaded, quiet
from pimper_torch.sfm.reconstruct_config import ReconstructConfig
from pimper_torch.sfm.workspace import Workspace

# Photographs in which a thread finds features between two reports of progress.
_PER_THREAD = 2


# The side of photographs below which COLMAP 4.2's covariant detector reads past their end.
SMALLEST_PX = 16


def too_small(views: Views) -> list[str]:
    """List photographs in which features cannot be looked for: COLMAP's process ends there."""
    small = (views.sizes_px < SMALLEST_PX).any(dim=1).tolist()
    return [name for name, one in zip(views.names, small, strict=True) if one]


def find_features(
    space: Workspace,
    settings: ReconstructConfig,
    focals_px: Sequence[float | None],
    lenses: Sequence[int],
) -> list[int]:
    """Find features and put them in the database, with one camera a lens.

    Args:
        space: Without a database, which is made. Where it has masks, features lie where they
            are not black.
        focals_px: Focal length of each photograph where it is known before. A camera shared by
            several photographs gets their median.
        lenses: Number of each photograph's lens; those of one lens have one size.
    """
    pycolmap = loaded()

    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = settings.num_threads
    options.sift.peak_threshold = settings.peak_threshold
    options.sift.edge_threshold = settings.edge_threshold
    options.sift.max_num_features = settings.max_features
    options.sift.estimate_affine_shape = settings.affine_shape
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = settings.camera_model
    if space.masked:
        reader.mask_path = str(space.masks)
    one = len(set(lenses)) == 1
    mode = pycolmap.CameraMode.SINGLE if one else pycolmap.CameraMode.PER_IMAGE
    with quiet():
        pycolmap.Database.open(space.database).close()
        _import(space, reader, lenses)
        with pycolmap.Database.open(space.database) as stored:
            _set_focals(stored, dict(zip(space.files, focals_px, strict=True)))
        step = _PER_THREAD * settings.num_threads
        starts = range(0, len(space.files), step)
        for start in track(starts):
            pycolmap.extract_features(
                space.database,
                space.images,
                list(space.files[start : start + step]),
                camera_mode=mode,
                reader_options=reader,
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )
        with pycolmap.Database.open(space.database) as stored:
            image_ids = {image.name: image.image_id for image in stored.read_all_images()}
            return [stored.num_keypoints_for_image(image_ids[file]) for file in space.files]


def _import(space: Workspace, reader: Any, lenses: Sequence[int]) -> None:  # noqa: ANN401 - no types
    """Put photographs in the database in their order, each with the camera of its lens."""
    pycolmap = loaded()
    cameras: dict[int, int] = {}
    for lens, run in groupby(zip(lenses, space.files, strict=True), key=itemgetter(0)):
        files = [file for _, file in run]
        reader.existing_camera_id = cameras.get(lens, -1)
        shared = pycolmap.CameraMode.SINGLE
        pycolmap.import_images(space.database, space.images, shared, files, reader)
        if lens not in cameras:
            with pycolmap.Database.open(space.database) as stored:
                cameras[lens] = stored.read_image_with_name(files[0]).camera_id
    reader.existing_camera_id = -1


def _set_focals(stored: Any, focals_px: dict[str, float | None]) -> None:  # noqa: ANN401 - no types
    known: dict[int, list[float]] = {}
    for image in stored.read_all_images():
        focal = focals_px[image.name]
        if focal is not None:
            known.setdefault(image.camera_id, []).append(focal)
    for camera in stored.read_all_cameras():
        if camera.camera_id not in known:
            continue
        params = np.array(camera.params)
        params[list(camera.focal_length_idxs())] = np.median(known[camera.camera_id])
        camera.params = params
        camera.has_prior_focal_length = True
        stored.update_camera(camera)
