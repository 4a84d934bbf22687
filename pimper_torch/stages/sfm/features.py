"""SIFT features of photographs, detected by COLMAP on the CPU."""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pimper_torch.geometry.colmap_library import loaded, quiet
from pimper_torch.radiometry import to_bytes
from pimper_torch.records import Views
from pimper_torch.runtime.mapped import drop_pages
from pimper_torch.runtime.memory import release_memory
from pimper_torch.runtime.progress import track
from pimper_torch.runtime.scratch import scratch
from pimper_torch.stages.sfm.reconstruct_config import ReconstructConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class Workspace:
    """A folder with the files of one run.

    Attributes:
        images: Folder of the photographs.
        files: Names of the photographs in ``images``, in the order of the views.
        masks: Folder with a mask of each, under its name plus ``.png``, as COLMAP requires.
        database: COLMAP's database.
    """

    folder: Path
    images: Path
    files: tuple[str, ...]
    masks: Path | None
    database: Path


@contextmanager
def workspace(views: Views, threads: int) -> Iterator[Workspace]:
    """Write photographs and masks to a temporary folder, which is removed when the block ends.

    Photographs are 8-bit gray in sRGB, without their padding.
    """
    with scratch() as folder:
        (images := folder / "images").mkdir()
        (masks := folder / "masks").mkdir()
        files = tuple(f"{index:06d}.png" for index in range(views.num_views))

        def write(index: int) -> None:
            width, height = (int(side) for side in views.sizes_px[index])
            pixels = to_bytes(views.images[index, :, :height, :width].detach()).cpu()
            picture = Image.fromarray(pixels.movedim(0, -1).squeeze(-1).numpy()).convert("L")
            # Fast compression: the files live for seconds. COLMAP uses luma alone.
            picture.save(images / files[index], compress_level=1)
            if views.masks is not None:
                mask = views.masks[index, :height, :width].cpu().numpy().astype(np.uint8) * 255
                Image.fromarray(mask).save(masks / f"{files[index]}.png", compress_level=1)
            drop_pages()

        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(write, range(views.num_views)))
        release_memory()
        yield Workspace(
            folder=folder,
            images=images,
            files=files,
            masks=None if views.masks is None else masks,
            database=folder / "database.db",
        )


# Side of photographs below which COLMAP 4.2's covariant detector reads out of bounds.
SMALLEST_PX = 16


def too_small(views: Views) -> list[str]:
    """List photographs too small for features: COLMAP would end the process."""
    small = (views.sizes_px < SMALLEST_PX).any(dim=1).tolist()
    return [name for name, is_small in zip(views.names, small, strict=True) if is_small]


def find_features(
    space: Workspace,
    settings: ReconstructConfig,
    focals_px: Sequence[float | None],
    lenses: Sequence[int],
) -> list[int]:
    """Detect features and write them to the database, with one camera per lens.

    Args:
        space: Without a database, which is created. If it has masks, features are only where they
            are not black.
        focals_px: Focal length of each photograph, if known. A camera shared by several photographs
            gets their median.
        lenses: Number of each photograph's lens; photographs of one lens have the same size.

    Returns:
        Number of features of each photograph.
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
    if space.masks:
        reader.mask_path = str(space.masks)
    shared = len(set(lenses)) == 1
    mode = pycolmap.CameraMode.SINGLE if shared else pycolmap.CameraMode.PER_IMAGE
    with quiet():
        pycolmap.Database.open(space.database).close()
        _import(space, reader, focals_px, lenses)
        step = 2 * settings.num_threads  # photographs between two reports of progress
        for start in track(range(0, len(space.files), step)):
            pycolmap.extract_features(
                space.database,
                space.images,
                list(space.files[start : start + step]),
                camera_mode=mode,
                reader_options=reader,
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )
        with pycolmap.Database.open(space.database) as database:
            return [database.num_keypoints_for_image(image) for image in image_ids(database, space)]


def image_ids(database: Any, space: Workspace) -> list[int]:  # noqa: ANN401 - pycolmap is untyped
    """Return the id of each photograph in the database."""
    ids = {image.name: image.image_id for image in database.read_all_images()}
    return [ids[file] for file in space.files]


def _import(
    space: Workspace,
    reader: Any,  # noqa: ANN401 - pycolmap is untyped
    focals_px: Sequence[float | None],
    lenses: Sequence[int],
) -> None:
    """Add photographs to the database in their order, each with the camera of its lens."""
    pycolmap = loaded()
    cameras: dict[int, int] = {}
    for lens, run in groupby(zip(lenses, space.files, strict=True), key=itemgetter(0)):
        files = [file for _, file in run]
        reader.existing_camera_id = cameras.get(lens, -1)
        shared = pycolmap.CameraMode.SINGLE
        pycolmap.import_images(space.database, space.images, shared, files, reader)
        if lens not in cameras:
            with pycolmap.Database.open(space.database) as database:
                cameras[lens] = database.read_image_with_name(files[0]).camera_id
    reader.existing_camera_id = -1
    with pycolmap.Database.open(space.database) as database:
        for number, camera_id in cameras.items():
            pairs = zip(focals_px, lenses, strict=True)
            if known := [focal for focal, lens in pairs if lens == number and focal is not None]:
                camera = database.read_camera(camera_id)
                params = np.array(camera.params)
                params[list(camera.focal_length_idxs())] = np.median(known)
                camera.params = params
                camera.has_prior_focal_length = True
                database.update_camera(camera)
