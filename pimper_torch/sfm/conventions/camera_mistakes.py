"""The usual mistakes in the conventions of cameras."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.geometry.frames import invert_rigid, rigid
from pimper_torch.geometry.pixels import scale_intrinsics
from pimper_torch.records import Cameras

_OTHER_SIZE = 0.2  # principal points stray by less than this fraction of half the image

Poses = Float[Tensor, "view 4 4"]


@dataclass(frozen=True, slots=True)
class CameraMistake:
    """One way in which cameras are commonly wrong.

    Attributes:
        remedy: What the user does about it.
    """

    meaning: str
    remedy: str
    undo: Callable[[Cameras], Cameras]


def camera_mistakes(cameras: Cameras) -> tuple[CameraMistake, ...]:
    """List the mistakes that these cameras may have, the commonest first.

    Another image size, and swapped rows and columns, are candidates only where the principal point
    is far from the centre.
    """
    return (*(_of_poses(*mistake) for mistake in _POSES), *_of_intrinsics(cameras))


def _of_poses(meaning: str, remedy: str, change: Callable[[Poses], Poses]) -> CameraMistake:
    def undo(cameras: Cameras) -> Cameras:
        return cameras.replace(cam_from_world=change(cameras.cam_from_world))

    return CameraMistake(meaning, remedy, undo)


def _signs(x: int, y: int, z: int, like: Poses) -> Float[Tensor, "4 4"]:
    return torch.diag(like.new_tensor([x, y, z, 1.0]))


def _from_center(pose: Poses) -> Poses:
    rotation = pose[:, :3, :3]
    return rigid(rotation, -(rotation @ pose[:, :3, 3:])[..., 0])


# Meanings and remedies of mistakes in cam_from_world, and the functions that undo them.
_POSES: tuple[tuple[str, str, Callable[[Poses], Poses]], ...] = (
    (
        "the poses take points from the camera to the world",
        "invert them: cam_from_world is world_from_cam to the power -1",
        invert_rigid,
    ),
    (
        "camera axes are x right, y up, z backward, as in OpenGL",
        "multiply cam_from_world from the left by diag(1, -1, -1, 1)",
        lambda pose: _signs(1, -1, -1, pose) @ pose,
    ),
    (
        "the poses go from camera to world, camera axes x right, y up, z backward, as in "
        "transforms.json",
        "multiply by diag(1, -1, -1, 1) from the right, then invert",
        lambda pose: invert_rigid(pose @ _signs(1, -1, -1, pose)),
    ),
    (
        "the rotations are transposed, the translations are not",
        "transpose the 3x3 block; row-major and column-major were confused",
        lambda pose: rigid(pose[:, :3, :3].mT, pose[:, :3, 3]),
    ),
    (
        "the last column holds the camera's centre",
        "put t = -R c there",
        _from_center,
    ),
    (
        "the photographs are turned by 180 degrees, or both image axes of the cameras are",
        "negate the first two rows of cam_from_world, or turn the photographs",
        lambda pose: _signs(-1, -1, 1, pose) @ pose,
    ),
)


def _of_intrinsics(cameras: Cameras) -> list[CameraMistake]:
    half = cameras.sizes_px.to(cameras.intrinsics) / 2
    center = cameras.intrinsics[:, :2, 2]
    mistakes = []
    # Both axes must ask for the same factor, or it is an off-centre lens or a crop.
    factors = half / torch.where(center.abs() > 0, center, torch.inf)
    factor = float(factors.median())
    same = bool(((factors / factor - 1).abs() < _OTHER_SIZE).all()) if factor > 0 else False
    if same and abs(factor - 1) > _OTHER_SIZE:
        size = CameraMistake(
            f"K is for photographs of 1/{factor:.4g} the size",
            f"multiply its first two rows by about {factor:.4g}, or read the photographs at the "
            "size it is for",
            lambda cameras: cameras.replace(
                intrinsics=scale_intrinsics(cameras.intrinsics, factor, factor)
            ),
        )
        mistakes.append(size)
    off = (center - half).norm(dim=1)
    if bool(((center.flip(-1) - half).norm(dim=1) < 0.5 * off).all()):
        swapped = CameraMistake(
            "K has the row of the principal point before its column",
            "exchange fx with fy and cx with cy",
            lambda cameras: cameras.replace(
                intrinsics=cameras.intrinsics[:, [1, 0, 2]][:, :, [1, 0, 2]]
            ),
        )
        mistakes.append(swapped)
    return mistakes
