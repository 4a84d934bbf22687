"""Common mistakes in the conventions of cameras, each with the transformation that undoes it."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.geometry.frames import invert_rigid, rigid
from pimper_torch.geometry.pixels import scale_intrinsics
from pimper_torch.records import Cameras

_OTHER_SIZE = 0.2  # principal points stray by less than this fraction of half the image


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraMistake:
    """One way in which cameras are commonly wrong.

    Attributes:
        name: Short, for programs.
        meaning: What was done.
        remedy: What the user does about it.
        undo: Gives the corrected cameras.
    """

    name: str
    meaning: str
    remedy: str
    undo: Callable[[Cameras], Cameras]


def camera_mistakes(cameras: Cameras) -> tuple[CameraMistake, ...]:
    """List the mistakes that these cameras may have, the commonest first.

    Another image size, and swapped rows and columns, are hypotheses only where the principal point
    is far from the centre.
    """
    return (*_POSES, *_intrinsics(cameras))


def _with_pose(
    change: Callable[[Float[Tensor, "view 4 4"]], Float[Tensor, "view 4 4"]],
) -> Callable[[Cameras], Cameras]:
    return lambda cameras: cameras.replace(cam_from_world=change(cameras.cam_from_world))


def _axes(x: int, y: int, z: int, like: Float[Tensor, "..."]) -> Float[Tensor, "4 4"]:
    return torch.diag(like.new_tensor([x, y, z, 1.0]))


def _from_center(pose: Float[Tensor, "view 4 4"]) -> Float[Tensor, "view 4 4"]:
    rotation = pose[:, :3, :3]
    return rigid(rotation, -(rotation @ pose[:, :3, 3:])[..., 0])


_POSES = (
    CameraMistake(
        name="world_from_cam",
        meaning="the poses take points from the camera to the world",
        remedy="invert them: cam_from_world is world_from_cam to the power -1",
        undo=_with_pose(invert_rigid),
    ),
    CameraMistake(
        name="opengl_axes",
        meaning="camera axes are x right, y up, z backward, as in OpenGL",
        remedy="multiply cam_from_world from the left by diag(1, -1, -1, 1)",
        undo=_with_pose(lambda pose: _axes(1, -1, -1, pose) @ pose),
    ),
    CameraMistake(
        name="world_from_cam_opengl",
        meaning="the poses go from camera to world, camera axes x right, y up, z backward, as in "
        "transforms.json",
        remedy="multiply by diag(1, -1, -1, 1) from the right, then invert",
        undo=_with_pose(lambda pose: invert_rigid(pose @ _axes(1, -1, -1, pose))),
    ),
    CameraMistake(
        name="transposed_rotation",
        meaning="the rotations are transposed, the translations are not",
        remedy="transpose the 3x3 block; row-major and column-major were confused",
        undo=_with_pose(lambda pose: rigid(pose[:, :3, :3].mT, pose[:, :3, 3])),
    ),
    CameraMistake(
        name="center_for_translation",
        meaning="the last column holds the camera's centre",
        remedy="put t = -R c there",
        undo=_with_pose(_from_center),
    ),
    CameraMistake(
        name="flipped_x",
        meaning="the cameras' x axis, or the photographs, run from right to left",
        remedy="negate the first row of cam_from_world, or mirror the photographs",
        undo=_with_pose(lambda pose: _axes(-1, 1, 1, pose) @ pose),
    ),
    CameraMistake(
        name="flipped_y",
        meaning="the cameras' y axis runs up, or the photographs are upside down",
        remedy="negate the second row of cam_from_world, or turn the photographs over",
        undo=_with_pose(lambda pose: _axes(1, -1, 1, pose) @ pose),
    ),
    CameraMistake(
        name="flipped_z",
        meaning="the cameras' z axis points backward",
        remedy="negate the third row of cam_from_world",
        undo=_with_pose(lambda pose: _axes(1, 1, -1, pose) @ pose),
    ),
    CameraMistake(
        name="photographs_rotated",
        meaning="the photographs are turned by 180 degrees, or both image axes of the cameras are",
        remedy="negate the first two rows of cam_from_world, or turn the photographs",
        undo=_with_pose(lambda pose: _axes(-1, -1, 1, pose) @ pose),
    ),
    CameraMistake(
        name="world_axes_flipped",
        meaning="y and z of the world run the other way for the cameras than for the truth",
        remedy="negate y and z of the mesh or points, or columns 2 and 3 of cam_from_world",
        undo=_with_pose(lambda pose: pose @ _axes(1, -1, -1, pose)),
    ),
)


def _intrinsics(cameras: Cameras) -> tuple[CameraMistake, ...]:
    half = cameras.sizes_px.to(cameras.intrinsics) / 2
    center = cameras.intrinsics[:, :2, 2]
    found: list[CameraMistake] = []
    # Both axes must ask for the same factor, or it is an off-centre lens or a crop.
    factors = half / torch.where(center.abs() > 0, center, torch.inf)
    factor = float(factors.median())
    same = bool(((factors / factor - 1).abs() < _OTHER_SIZE).all()) if factor > 0 else False
    if same and abs(factor - 1) > _OTHER_SIZE:
        found.append(
            CameraMistake(
                name="intrinsics_of_another_size",
                meaning=f"K is for photographs of 1/{factor:.4g} the size",
                remedy=f"multiply its first two rows by about {factor:.4g}, or read the "
                "photographs at the size it is for",
                undo=lambda cameras: cameras.replace(
                    intrinsics=scale_intrinsics(cameras.intrinsics, factor, factor)
                ),
            )
        )
    swapped = center.flip(-1)
    if bool(((swapped - half).norm(dim=1) < 0.5 * (center - half).norm(dim=1)).all()):
        found.append(
            CameraMistake(
                name="rows_and_columns_swapped",
                meaning="K has the row of the principal point before its column",
                remedy="exchange fx with fy and cx with cy",
                undo=_with_swapped,
            )
        )
    return tuple(found)


def _with_swapped(cameras: Cameras) -> Cameras:
    order = torch.tensor([1, 0, 2], device=cameras.intrinsics.device)
    return cameras.replace(intrinsics=cameras.intrinsics[:, order][:, :, order])
