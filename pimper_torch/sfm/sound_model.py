"""The valid part of a COLMAP model; broken cameras, poses, points, observations are dropped."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.errors import InputError, caution, some
from pimper_torch.geometry.rigid import rigid
from pimper_torch.ledger import leave_out
from pimper_torch.records import Lens
from pimper_torch.sfm.model import SparseModel
from pimper_torch.sfm.model_files import FileImage, FileModel

# Choices: a model of which more is broken is not believed; no photograph is wider or higher.
_MAX_BROKEN, _MAX_SIDE = 0.5, 10**6
# COLMAP writes quaternions of length 1; other programs round them. Poses and points beyond
# this leave the range of single precision.
_UNIT, _MAX_COORDINATE = 0.1, 1e30


def sound_model(files: FileModel, folder: Path) -> SparseModel:
    """Keep what is sound, warn of the rest with its count; views and points by their numbers.

    Broken are cameras whose parameters are not finite or whose focal length is not above 0; images
    of these, with a pose that is not finite or a quaternion that is none, or that stand twice;
    points that are not finite; and observations that name an image or a feature that is not
    there.

    Raises:
        InputError: More than half of the images or points are broken: says why.
    """
    lenses = {one.camera: one for one in files.cameras if _camera_fault(one) == ""}
    kept, faults, seen = [], dict[str, list[str]](), set[object]()
    for image in sorted(files.images, key=lambda one: one.image):
        fault = _image_fault(image, files, lenses)
        if not fault and not seen.isdisjoint({image.image, image.name}):
            fault = "stand in it twice"
        if fault:
            faults.setdefault(fault, []).append(image.name)
        else:
            kept.append(image)
            seen |= {image.image, image.name}
    points, order = files.points, np.argsort(files.points.points, kind="stable")
    finite = (np.abs(points.xyz) < _MAX_COORDINATE).all(axis=1)
    dropped = [
        f"{len(names)} of {len(files.images)} images ({some(names, 4)}), which {fault}"
        for fault, names in faults.items()
    ]
    nowhere = int((~finite).sum())
    broken = [name for names in faults.values() for name in names]
    leave_out("sfm.broken_images", len(broken), total=len(files.images), names=broken)
    leave_out("sfm.broken_points", nowhere, total=len(finite))
    if nowhere:
        dropped.append(f"{nowhere} of {len(finite)} points, whose coordinates are not finite")
    broken_images = len(files.images) - len(kept) > _MAX_BROKEN * len(files.images)
    if broken_images or nowhere > _MAX_BROKEN * len(finite):
        raise InputError(
            f"The COLMAP model in {folder} is broken: unusable are {'; '.join(dropped)}. Needed: a "
            "model of which at least half is sound. Write it again, or leave it out to run "
            "structure from motion."
        )
    used = order[finite[order]]
    new_point = np.full(len(finite), -1)
    new_point[used] = np.arange(len(used))
    observations, lost = _observations(files, kept, new_point)
    if lost:
        total = int((new_point[points.track_point] >= 0).sum())
        dropped.append(f"{lost} of {total} observations, which name no feature of an image")
    if dropped:
        caution(
            f"The COLMAP model in {folder} is partly broken. Left out are {'; '.join(dropped)}. "
            "Write it again if these matter."
        )
    point, view, pixels = observations
    return SparseModel(
        names=tuple(image.name for image in kept),
        lenses=tuple(lenses[image.camera] for image in kept),
        cam_from_world=torch.stack([_pose(image) for image in kept])
        if kept
        else torch.zeros(0, 4, 4, dtype=torch.float64),
        points_world=torch.from_numpy(points.xyz[used]),
        observation_point=torch.from_numpy(point),
        observation_view=torch.from_numpy(view),
        observation_pixels=torch.from_numpy(pixels),
    )


def _camera_fault(camera: Lens) -> str:
    if camera.model == "EQUIRECTANGULAR":
        return "have a camera without a focal length, EQUIRECTANGULAR"
    if not all(0 < side <= _MAX_SIDE for side in (camera.width, camera.height)):
        return f"are {camera.width} x {camera.height} pixels large by their camera"
    if not all(abs(value) < _MAX_COORDINATE for value in camera.params):
        return "have a camera whose parameters are not finite"
    one = camera.model.startswith(("SIMPLE", "RADIAL"))  # focal length for both axes
    positive = min(camera.params[: 1 if one else 2]) > 0
    return "" if positive else "have a camera whose focal length is not above 0"


def _image_fault(image: FileImage, files: FileModel, lenses: dict[int, Lens]) -> str:
    length = float(np.linalg.norm(image.quaternion))
    if not abs(length - 1) <= _UNIT:
        return "have a pose whose quaternion is not of length 1"
    if not all(abs(value) < _MAX_COORDINATE for value in image.translation):
        return "have a pose that is not finite"
    if image.camera in lenses:
        return ""
    broken = [one for one in files.cameras if one.camera == image.camera]
    return _camera_fault(broken[0]) if broken else "have no camera"


def _pose(image: FileImage) -> Float[Tensor, "4 4"]:
    """Turn a quaternion, real part first, into a rotation."""
    quaternion = torch.tensor(image.quaternion, dtype=torch.float64)
    w, x, y, z = (quaternion / quaternion.norm()).tolist()
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return rigid(
        torch.tensor(rotation, dtype=torch.float64),
        torch.tensor(image.translation, dtype=torch.float64),
    )


def _observations(
    files: FileModel, kept: list[FileImage], new_point: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], int]:
    """Return point, view and pixel of each sound observation by rising point; count the others.

    Observations of what was dropped are not counted.
    """
    track = files.points
    view_of = {image.image: view for view, image in enumerate(kept)}
    dropped = [image.image for image in files.images if image.image not in view_of]
    view = np.array([view_of.get(image, -1) for image in track.track_image.tolist()], np.int64)
    starts = np.cumsum([0, *(len(image.pixels) for image in kept)])
    pixels = np.concatenate([np.zeros((0, 2)), *(image.pixels for image in kept)])
    point = new_point[track.track_point]
    seen = (point >= 0) & ~np.isin(track.track_image, dropped)
    there = (view >= 0) & (track.track_feature >= 0)
    there &= track.track_feature < np.append(np.diff(starts), 0)[view]
    feature = starts[view[there]] + track.track_feature[there]
    sound = seen & there
    sound[there] &= (np.abs(pixels[feature]) < _MAX_COORDINATE).all(axis=1)
    chosen = np.flatnonzero(sound)
    chosen = chosen[np.argsort(point[chosen], kind="stable")]
    found = pixels[starts[view[chosen]] + track.track_feature[chosen]]
    return (point[chosen], view[chosen], found), int((seen & ~sound).sum())
