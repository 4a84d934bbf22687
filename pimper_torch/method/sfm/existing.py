"""A COLMAP model, or a file of cameras, that the photographs come with."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import torch
from PIL import Image

from pimper_torch.doors.camera_files.read_cameras import read_cameras
from pimper_torch.doors.camera_files.transforms_json import read_cloud
from pimper_torch.ground.geometry.lens_models import rescale_lens
from pimper_torch.method.sfm import colmap, lenses
from pimper_torch.method.sfm.model import SparseModel, select_views
from pimper_torch.method.sfm.model_files import largest_model
from pimper_torch.records import CameraModel, Views
from pimper_torch.runtime.errors import InputError, ReconstructionError, caution, some
from pimper_torch.runtime.file_names import match_poses


def existing_model(views: Views, path: Path) -> SparseModel:
    """Read cameras and put them in the photographs' order, sizes and orientations.

    Args:
        views: Matched by file name; photographs of one folder that the cameras lack have the camera
            of their pose. Cameras may have been made from photographs of another size, and from the
            pixels that files store where EXIF turns them by a quarter.
        path: Folder of a COLMAP model, or of several in folders, of which the
            largest is read; or a file of cameras, see
            :func:`~pimper_torch.doors.camera_files.read_cameras.read_cameras`.

    Returns:
        With the cloud that a file of cameras names, which no view observes yet.

    Raises:
        ReconstructionError: There are cameras of fewer than 3 of the photographs.
        InputError: They do not belong to the photographs, or cannot be read.
    """
    path = largest_model(path)
    where = source_label(path)
    read = _model_of_file(views, path) if path.is_file() else colmap.read_model(path)
    found = match_poses(views.names, read.names, folder=views.folder, where=where, what="image")
    own = {name: at for name, at in zip(views.names, found, strict=True) if at is not None}
    if not own:
        raise InputError(
            f"{where} has none of the photographs. Its images are {some(read.names)}; the "
            f"photographs are {some(views.names)}. Rename the photographs to match, or leave the "
            "model out to run structure from motion."
        )
    model = select_views(read, list(own.values())).replace(names=tuple(own))
    if model.num_views < 3:
        raise ReconstructionError(
            f"{where} holds {model.num_views} of {views.num_views} "
            f"photographs ({', '.join(model.names)}); at least 3 are needed. Use a model that "
            "holds more of them, or leave it out to run structure from motion."
        )
    shown = registered_views(views, model)
    placed = _in_photographs(model, shown, _quarter_turns(model, shown, where))
    return placed.replace(points_world=read_cloud(path)) if path.is_file() else placed


def resize_fits(lens: CameraModel, width: int, height: int) -> bool:
    """Return whether a resize alone leads from a lens's picture to one of a different size."""
    # Rounding a side to whole pixels changes the shape by less than this.
    ratio = width / lens.width / (height / lens.height)
    return abs(ratio - 1) <= max(0.01, 2 / min(width, height))


def _quarter_turns(model: SparseModel, views: Views, where: str) -> list[int]:
    """Return the clockwise quarters by which a model's pictures are turned in the photographs.

    Programs work on the pixels of files, which EXIF may say are to be turned; photographs are
    turned when they are read. One photograph whose shape shows it decides for all.
    """
    tags = [1] * views.num_views if views.orientations is None else views.orientations.tolist()
    exif = [lenses.QUARTERS.get(tag, 0) for tag in tags]
    sizes = views.sizes_px.tolist()
    odd = [
        f"{name} is {width}x{height}, its camera's picture {lens.width}x{lens.height}"
        for name, lens, (width, height) in zip(model.names, model.lenses, sizes, strict=True)
        if not resize_fits(lens, width, height)
    ]
    as_stored = all(
        resize_fits(lens, *lenses.turned_size(width, height, quarters))
        for lens, (width, height), quarters in zip(model.lenses, sizes, exif, strict=True)
    )
    if odd and not as_stored:
        raise InputError(
            f"{where} is of pictures of another shape than {len(odd)} of {model.num_views} "
            f"photographs: {some(odd, 2)}. Needed: the photographs that it was made of, resized "
            "if you like, but neither cropped nor turned since. Give those, or leave the cameras "
            "out to find them by structure from motion."
        )
    if odd:
        caution(
            f"{where}: its cameras are of the pixels that files store before EXIF turns them, and "
            "are turned with the photographs.",
            stacklevel=4,
        )
        return exif
    if as_stored and any(exif):
        caution(
            f"{where}: EXIF turns photographs, and their shapes do not show whether the cameras "
            "were found before or after that; they are taken as found after. If they are of the "
            "pixels that files store, remove EXIF's orientation (`exiftool -n -Orientation=1`).",
            stacklevel=4,
        )
    return [0] * model.num_views


def source_label(path: Path) -> str:
    """State what cameras come from, at the start of a sentence."""
    return f"The file of cameras {path}" if path.is_file() else f"The COLMAP model in {path}"


def registered_views(views: Views, model: SparseModel) -> Views:
    """Take the photographs of a model, in its order."""
    return views.take([views.names.index(name) for name in model.names])


def _model_of_file(views: Views, path: Path) -> SparseModel:
    """Read cameras that come without points."""
    cameras = read_cameras(path, views.names, lambda names: _stored_sizes(views, names, path))
    if not cameras:
        raise InputError(
            f"{path}: has no camera of {some(views.names)}; needed: cameras of these "
            "photographs, by their names."
        )
    names = [camera.name.replace("\\", "/") for camera in cameras]
    skewed = [
        one.name
        for one in cameras
        if abs(one.skew_px) * one.lens.height > 0.2 * one.lens.params[1]  # 0.1 px in the corners
    ]
    twice = sorted({name for name in names if names.count(name) > 1})
    if skewed or twice:
        found = f"a skew in {some(skewed)}" if skewed else f"several cameras of {some(twice)}"
        raise InputError(
            f"{path}: found {found}; needed: one camera a photograph, with axes at right angles. "
            "Export the cameras of undistorted photographs."
        )
    return SparseModel(
        names=tuple(names),
        lenses=tuple(camera.lens for camera in cameras),
        cam_from_world=torch.stack([camera.cam_from_world for camera in cameras]),
    )


def _stored_sizes(views: Views, names: Sequence[str], path: Path) -> list[tuple[int, int] | None]:
    """Return the sizes of photographs in their files, which others' programs count pixels of."""
    where = source_label(path)
    found = match_poses(views.names, names, folder=views.folder, where=where, what="camera")
    sizes: list[tuple[int, int] | None] = [None] * len(names)
    for name, at, (width, height) in zip(views.names, found, views.sizes_px.tolist(), strict=True):
        if at is not None:
            sizes[at] = width, height  # as they were read, where there is no file
            with suppress(OSError, ValueError, Image.DecompressionBombError):
                if views.folder:
                    with Image.open(Path(views.folder) / name) as picture:
                        # The picture in a file of camera raw may be its preview.
                        if max(picture.size) >= max(width, height):
                            sizes[at] = picture.size
    return sizes


def _in_photographs(model: SparseModel, views: Views, turns: Sequence[int]) -> SparseModel:
    """Resize a model's pictures to its photographs, and turn them by clockwise quarters."""
    placed = []
    cameras: dict[tuple[int, ...], int] = {}
    fresh = 1 + max(lens.camera for lens in model.lenses)
    pixels = torch.empty_like(model.observation_pixels)
    poses = torch.empty_like(model.cam_from_world)
    for view, (lens, quarters) in enumerate(zip(model.lenses, turns, strict=True)):
        width, height = views.sizes_px[view].tolist()
        size = lenses.turned_size(width, height, quarters)
        # Photographs of one camera that were resized or turned differently no longer share it; the
        # first of them keep its number.
        key, known = (lens.camera, *size, quarters), lens.camera in cameras.values()
        camera = cameras.setdefault(key, fresh + len(cameras) if known else lens.camera)
        resized = rescale_lens(lens, *size).replace(camera=camera)
        placed.append(lenses.turned_lens(resized, quarters))
        scale = pixels.new_tensor([size[0] / lens.width, size[1] / lens.height])
        here = model.observation_view == view
        pixels[here] = lenses.turned_pixels(model.observation_pixels[here] * scale, *size, quarters)
        poses[view] = lenses.turned_pose(model.cam_from_world[view], quarters)
    return model.replace(lenses=tuple(placed), cam_from_world=poses, observation_pixels=pixels)
