"""Cameras of photographs that stand turned by quarters from how the truth has them.

EXIF turns a photograph, and with it the camera that a result has for it; the truth may hold the
same photograph as the sensor read it. Axes of such cameras say nothing about the world's
rotation before the turns are undone.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.evidence.metrics.similarity import camera_correlation, nearest_rotation
from pimper_torch.records import Cameras
from pimper_torch.sfm.quarter_turns import turned_pose, turned_size, turning

# How much better turned cameras must agree, of their agreement, to be taken for turned.
_CLEARLY = 1e-6


def standing_as(ours: Cameras, truth: Cameras) -> Cameras:
    """Turn cameras by the quarters that bring them nearest to true ones; mostly none.

    Two rotations of the world are tried, the one that all axes and centres give, and the one
    that optical axes and centres give, which no turn changes. Each tells every camera's
    quarters; the pair that agrees better is taken, and no turn where both agree as well.

    Args:
        ours: World frame of the result.
        truth: The same views in the same order; fewer than two tell nothing.
    """
    if ours.num_views < 2:
        return ours
    best, quarters_best = -math.inf, [0] * ours.num_views
    for axes in (slice(0, 3), slice(2, 3)):
        rotation = nearest_rotation(camera_correlation(ours, truth, axes))
        quarters = _quarters(ours, truth, rotation)
        correlation = camera_correlation(_turned(ours, quarters), truth)
        agreement = float((nearest_rotation(correlation) * correlation).sum())
        if agreement > best + _CLEARLY * abs(agreement):
            best, quarters_best = agreement, quarters
    return _turned(ours, quarters_best)


def _quarters(ours: Cameras, truth: Cameras, rotation: Float[Tensor, "3 3"]) -> list[int]:
    """Return the clockwise quarters that bring each camera nearest to the true one."""
    axes = ours.cam_from_world[:, :3, :3].double() @ rotation.mT
    between = truth.cam_from_world[:, :3, :3].double() @ axes.mT
    angle = torch.atan2(between[:, 1, 0] - between[:, 0, 1], between[:, 0, 0] + between[:, 1, 1])
    return [int(turns) % 4 for turns in (angle / (math.pi / 2)).round().tolist()]


def _turned(cameras: Cameras, quarters: Sequence[int]) -> Cameras:
    if not any(quarters):
        return cameras
    sizes = cameras.sizes_px.tolist()
    turns = [
        turning(width, height, number)
        for (width, height), number in zip(sizes, quarters, strict=True)
    ]
    poses = [
        turned_pose(pose, number)
        for pose, number in zip(cameras.cam_from_world, quarters, strict=True)
    ]
    # A turned pinhole: the picture's turn after the lens, the axes' turn undone before it.
    intrinsics = [
        turn @ lens.double() @ turned_pose(torch.eye(4).double(), number)[:3, :3].mT
        for turn, lens, number in zip(turns, cameras.intrinsics, quarters, strict=True)
    ]
    return cameras.replace(
        intrinsics=torch.stack(intrinsics).to(cameras.intrinsics),
        cam_from_world=torch.stack(poses),
        sizes_px=torch.tensor(
            [
                turned_size(width, height, number)
                for (width, height), number in zip(sizes, quarters, strict=True)
            ]
        ).to(cameras.sizes_px),
    )
