"""The usual mistakes in the conventions of cameras."""

from typing import NamedTuple

import torch

from pimper_torch.geometry.pixels import scale_intrinsics
from pimper_torch.geometry.rigid import invert_rigid, rigid
from pimper_torch.records import Cameras

_OTHER_SIZE = 0.2  # principal points stray by less than this fraction of half the image


class CameraReading(NamedTuple):
    """Cameras put right in one way in which they are commonly wrong.

    Attributes:
        remedy: What the user does about it.
    """

    meaning: str
    remedy: str
    cameras: Cameras


def camera_readings(cameras: Cameras) -> list[CameraReading]:
    """Undo each of the mistakes that cameras may have, the commonest first.

    Another image size is a candidate only where the principal point is far from the centre.
    """
    poses = cameras.cam_from_world
    rotations, shifts = poses[:, :3, :3], poses[:, :3, 3]
    opengl, turned = (
        torch.diag(poses.new_tensor([*signs, 1.0])) for signs in ((1, -1, -1), (-1, -1, 1))
    )
    readings = [
        (
            "the poses take points from the camera to the world",
            "invert them: cam_from_world is world_from_cam to the power -1",
            invert_rigid(poses),
        ),
        (
            "camera axes are x right, y up, z backward, as in OpenGL",
            "multiply cam_from_world from the left by diag(1, -1, -1, 1)",
            opengl @ poses,
        ),
        (
            "the poses go from camera to world, camera axes x right, y up, z backward, as in "
            "transforms.json",
            "multiply by diag(1, -1, -1, 1) from the right, then invert",
            invert_rigid(poses @ opengl),
        ),
        (
            "the rotations are transposed, the translations are not",
            "transpose the 3x3 block; row-major and column-major were confused",
            rigid(rotations.mT, shifts),
        ),
        (
            "the last column holds the camera's centre",
            "put t = -R c there",
            rigid(rotations, -(rotations @ shifts[..., None])[..., 0]),
        ),
        (
            "the photographs are turned by 180 degrees, or both image axes of the cameras are",
            "negate the first two rows of cam_from_world, or turn the photographs",
            turned @ poses,
        ),
    ]
    found = [
        CameraReading(meaning, remedy, cameras.replace(cam_from_world=right))
        for meaning, remedy, right in readings
    ]
    # Both axes must ask for the same factor, or it is an off-centre lens or a crop.
    center = cameras.intrinsics[:, :2, 2]
    factors = cameras.sizes_px.to(center) / 2 / torch.where(center.abs() > 0, center, torch.inf)
    factor = float(factors.median())
    same = factor > 0 and bool(((factors / factor - 1).abs() < _OTHER_SIZE).all())
    if same and abs(factor - 1) > _OTHER_SIZE:
        right = scale_intrinsics(cameras.intrinsics, factor, factor)
        resized = CameraReading(
            f"K is for photographs of 1/{factor:.4g} the size",
            f"multiply its first two rows by about {factor:.4g}, or read the photographs at the "
            "size it is for",
            cameras.replace(intrinsics=right),
        )
        found.append(resized)
    return found
