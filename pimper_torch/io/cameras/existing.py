"""Given cameras: a COLMAP model, or a camera file."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import torch
from PIL import Image

from pimper_torch.geometry import quarter_turns
from pimper_torch.geometry.lens_models import rescale_lens
from pimper_torch.io.cameras.model_files import largest_model, read_model
from pimper_torch.io.cameras.read_cameras import read_cameras
from pimper_torch.io.cameras.transforms_json import read_cloud
from pimper_torch.records import CameraModel, Views
from pimper_torch.records.sparse_model import SparseModel, select_views
from pimper_torch.runtime.errors import InputError, ReconstructionError, caution, some
from pimper_torch.runtime.file_names import match_poses


def existing_model(views: Views, path: Path) -> SparseModel:
    """Read cameras, and adapt them to the photographs' order, sizes and orientations.

    Args:
        views: Matched by file name; photographs in folders per pose without a camera have the
            camera of their pose. Cameras may be of images of a different size, and of the stored
            pixels if EXIF turns them by a quarter.
        path: Folder of a COLMAP model, or of subfolders with models, of which the largest is read;
            or a camera file, or a folder of these, see
            :func:`~pimper_torch.io.cameras.read_cameras.read_cameras`.

    Returns:
        With the point cloud that a camera file names, without observations.

    Raises:
        ReconstructionError: Fewer than 3 of the photographs have a camera.
        InputError: The cameras do not belong to the photographs, or cannot be read.
    """
    path = largest_model(path)
    where = source_label(path)
    read = _model_of_file(views, path) if path.is_file() else read_model(path)
    indices = match_poses(views.names, read.names, folder=views.folder, where=where, what="image")
    index_of = {name: i for name, i in zip(views.names, indices, strict=True) if i is not None}
    if not index_of:
        raise InputError(
            f"{where} has none of the photographs. Its images are {some(read.names)}; the "
            f"photographs are {some(views.names)}. Rename the photographs to match, or omit the "
            "model to run structure from motion."
        )
    model = select_views(read, list(index_of.values())).replace(names=tuple(index_of))
    if model.num_views < 3:
        raise ReconstructionError(
            f"{where} contains {model.num_views} of {views.num_views} photographs "
            f"({', '.join(model.names)}); at least 3 are needed. Use a model that contains more of "
            "them, or omit it to run structure from motion."
        )
    registered = registered_views(views, model)
    placed = _in_photographs(model, registered, _quarter_turns(model, registered, where))
    return placed.replace(points_world=read_cloud(path)) if path.is_file() else placed


def resize_fits(lens: CameraModel, width: int, height: int) -> bool:
    """Return whether a lens's image, resized only, can have the given size."""
    # Rounding a side to integer pixels changes the aspect ratio by less than this.
    ratio = width / lens.width / (height / lens.height)
    return abs(ratio - 1) <= max(0.01, 2 / min(width, height))


def _quarter_turns(model: SparseModel, views: Views, where: str) -> list[int]:
    """Return the number of clockwise quarter turns from a model's images to the photographs.

    Programs may use the stored pixels, which EXIF may turn; photographs are turned when they are
    read. One photograph whose shape is conclusive decides for all.
    """
    tags = [1] * views.num_views if views.orientations is None else views.orientations.tolist()
    exif = [quarter_turns.QUARTERS.get(tag, 0) for tag in tags]
    sizes = views.sizes_px.tolist()
    odd = [
        f"{name} is {width}x{height}, its camera's image {lens.width}x{lens.height}"
        for name, lens, (width, height) in zip(model.names, model.lenses, sizes, strict=True)
        if not resize_fits(lens, width, height)
    ]
    as_stored = all(
        resize_fits(lens, *quarter_turns.turned_size(width, height, quarters))
        for lens, (width, height), quarters in zip(model.lenses, sizes, exif, strict=True)
    )
    if odd and not as_stored:
        raise InputError(
            f"{where} is of images with another aspect ratio than {len(odd)} of {model.num_views} "
            f"photographs: {some(odd, 2)}. Needed: the photographs that it was made of, possibly "
            "resized, but neither cropped nor turned. Give those, or omit the cameras to find them "
            "by structure from motion."
        )
    if odd:
        caution(
            f"{where}: its cameras are for the stored pixels before EXIF turns them, and are "
            "turned with the photographs.",
            stacklevel=4,
        )
        return exif
    if as_stored and any(exif):
        caution(
            f"{where}: EXIF turns photographs, and their shapes do not show whether the cameras "
            "are for the pixels before or after that; after is assumed. If they are for the stored "
            "pixels, remove EXIF's orientation (`exiftool -n -Orientation=1`).",
            stacklevel=4,
        )
    return [0] * model.num_views


def source_label(path: Path) -> str:
    """Return a description of the source of cameras, to begin a sentence."""
    if path.is_file():
        return f"The camera file {path}"
    return f"The {'cameras' if any(path.glob('*.json')) else 'COLMAP model'} in {path}"


def registered_views(views: Views, model: SparseModel) -> Views:
    """Return the photographs of a model, in its order."""
    return views.take([views.names.index(name) for name in model.names])


def _model_of_file(views: Views, path: Path) -> SparseModel:
    """Read a camera file as a model without points."""
    cameras = read_cameras(path, views.names, lambda names: _stored_sizes(views, names, path))
    if not cameras:
        raise InputError(
            f"{path}: contains no camera of {some(views.names)}; needed: cameras with the names of "
            "these photographs."
        )
    names = [camera.name.replace("\\", "/") for camera in cameras]
    skewed = [
        x.name
        for x in cameras
        if abs(x.skew_px) * x.lens.height > 0.2 * x.lens.params[1]  # 0.1 px in the corners
    ]
    twice = sorted({name for name in names if names.count(name) > 1})
    if skewed or twice:
        fault = f"a skew in {some(skewed)}" if skewed else f"several cameras of {some(twice)}"
        raise InputError(
            f"{path}: found {fault}; needed: one camera per photograph, with orthogonal axes. "
            "Export the cameras of undistorted photographs."
        )
    return SparseModel(
        names=tuple(names),
        lenses=tuple(camera.lens for camera in cameras),
        cam_from_world=torch.stack([camera.cam_from_world for camera in cameras]),
    )


def _stored_sizes(views: Views, names: Sequence[str], path: Path) -> list[tuple[int, int] | None]:
    """Return the sizes of photographs in their files; pixels of other programs refer to these."""
    where = source_label(path)
    indices = match_poses(views.names, names, folder=views.folder, where=where, what="camera")
    sizes: list[tuple[int, int] | None] = [None] * len(names)
    for name, i, (width, height) in zip(views.names, indices, views.sizes_px.tolist(), strict=True):
        if i is not None:
            sizes[i] = width, height  # as loaded, if there is no file
            with suppress(OSError, ValueError, Image.DecompressionBombError):
                if views.folder:
                    with Image.open(Path(views.folder) / name) as picture:
                        # The image in a raw file may be its preview.
                        if max(picture.size) >= max(width, height):
                            sizes[i] = picture.size
    return sizes


def _in_photographs(model: SparseModel, views: Views, turns: Sequence[int]) -> SparseModel:
    """Resize a model's images to its photographs, and turn them by clockwise quarters."""
    placed = []
    cameras: dict[tuple[int, ...], int] = {}
    next_camera = 1 + max(lens.camera for lens in model.lenses)
    pixels = torch.empty_like(model.observation_pixels)
    poses = torch.empty_like(model.cam_from_world)
    for view, (lens, quarters) in enumerate(zip(model.lenses, turns, strict=True)):
        width, height = views.sizes_px[view].tolist()
        size = quarter_turns.turned_size(width, height, quarters)
        # Photographs of one camera that were resized or turned differently no longer share it; the
        # first of them keep its number.
        key, is_used = (lens.camera, *size, quarters), lens.camera in cameras.values()
        camera = cameras.setdefault(key, next_camera + len(cameras) if is_used else lens.camera)
        resized = rescale_lens(lens, *size).replace(camera=camera)
        placed.append(quarter_turns.turned_lens(resized, quarters))
        scale = pixels.new_tensor([size[0] / lens.width, size[1] / lens.height])
        rows = model.observation_view == view
        pixels[rows] = quarter_turns.turned_pixels(
            model.observation_pixels[rows] * scale, *size, quarters
        )
        poses[view] = quarter_turns.turned_pose(model.cam_from_world[view], quarters)
    return model.replace(lenses=tuple(placed), cam_from_world=poses, observation_pixels=pixels)
