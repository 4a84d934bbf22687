"""The local frame of a scene far from its origin: shifted, neither rotated nor scaled.

Georeferenced models have coordinates of 1e5 units and more, which single precision rounds to
hundredths. The local frame has its origin near the object.
"""

import math

import torch

from pimper_torch.geometry.rigid import rigid
from pimper_torch.records.shapes import Points, Poses

Offset = tuple[float, float, float]

NO_OFFSET: Offset = (0.0, 0.0, 0.0)


def local_origin(cam_from_world: Poses, points_world: Points) -> Offset:
    """Choose the origin of a scene's local frame, in round numbers; zero if no shift is needed.

    It is the rounded median, which ignores outliers, of the cloud, or of the cameras without one.

    Args:
        points_world: The cloud; may be empty.

    >>> poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    >>> poses[:, 0, 3] = torch.tensor([-500_002.0, -500_000.0])
    >>> local_origin(poses, torch.zeros(0, 3, dtype=torch.float64))
    (500000.0, 0.0, 0.0)
    """
    poses = cam_from_world.detach().double()
    centers = -(poses[:, :3, :3].mT @ poses[:, :3, 3:])[..., 0]
    points = points_world.detach().to(centers)
    points = points[points.isfinite().all(dim=1)]
    centers = centers[centers.isfinite().all(dim=1)]
    if len(centers) == 0:
        return NO_OFFSET
    middle = (points if len(points) else centers).median(dim=0).values
    radius = float((centers - middle).norm(dim=1).median())
    if radius == 0:  # most cameras are at the median
        radius = float((centers - middle).norm(dim=1).max())
    # Beyond this, rounding to single precision moves points by a thousandth of a pixel of 2000.
    if radius == 0 or float(middle.norm()) <= 10.0 * radius:
        return NO_OFFSET
    digits = -math.floor(math.log10(radius))
    x, y, z = (round(value, digits) + 0.0 for value in middle.tolist())  # no -0.0
    return x, y, z


def to_local(cam_from_world: Poses, offset: Offset) -> Poses:
    """Return the poses for points with ``offset`` subtracted; differentiable."""
    rotation, translation = cam_from_world[:, :3, :3], cam_from_world[:, :3, 3]
    return rigid(rotation, translation + rotation @ rotation.new_tensor(offset))


def from_local(cam_from_local: Poses, offset: Offset) -> Poses:
    """Invert :func:`to_local`, in float64.

    Rotations are orthogonalized: their rounding times the offset would shift the cameras' centres.
    """
    if offset == NO_OFFSET:
        return cam_from_local.double()
    U, _, Vh = torch.linalg.svd(cam_from_local[:, :3, :3].double())
    rotation = U @ Vh
    shift = rotation @ rotation.new_tensor(offset)
    return rigid(rotation, cam_from_local[:, :3, 3].double() - shift)
