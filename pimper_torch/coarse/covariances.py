"""Covariances of the triangulated points of the cloud."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.geometry.rigid import transform
from pimper_torch.records import SparseScene

# Degrees of freedom that the median over all points counts for beside a point's own
# residuals, of which a track of three views leaves three. A choice.
_COMMON_FREEDOM = 6.0

# Fraction of its mean information that a point has at least in every direction: the standard
# deviation of its depth is at most 1,000 times that across, as where only one view sees it.
_MIN_INFORMATION = 1e-6


def point_covariances(
    scene: SparseScene, index: Int[Tensor, " chosen"]
) -> Float[Tensor, "chosen 3 3"]:
    r"""Return the covariance of triangulated points.

    .. math:: C = \sigma^2 \Big( \sum_{views} J^T J \Big)^{-1}

    with J the derivative of the pixel by the point: a point is uncertain along its rays, the
    more so the farther it is and the narrower the angle between them. The pixel's noise
    :math:`\sigma` is estimated from the point's mean reprojection error :math:`e` over n
    views, :math:`\sigma^2 = (2 e^2 / \pi) \, 2n / (2n - 3)` for Gaussian noise, blended with
    the median of the cloud, as a short track says little about its own noise. Cameras are
    taken as exact.

    Returns:
        Scene units squared.

    Source: Hartley & Zisserman, Multiple View Geometry, 2nd ed., section 5.2, for the
    back-propagation of pixel noise.
    """
    cameras, point = scene.cameras, scene.observation_point
    view, count = scene.observation_view, len(scene.points_world)
    frames = cameras.cam_from_world[view].double()
    intrinsics = cameras.intrinsics[view].double()
    points = transform(frames, scene.points_world[point, None].double())
    depth = points[:, 0, 2, None, None]
    pixel = (points @ intrinsics.mT)[:, 0, :2, None] / depth
    inward = intrinsics.new_tensor([0, 0, 1])
    rate = (intrinsics[:, :2] - pixel * inward) / depth @ frames[:, :3, :3]
    information = rate.new_zeros(count, 3, 3).index_add(0, point, rate.mT @ rate)[index]
    least = _MIN_INFORMATION * information.diagonal(dim1=-2, dim2=-1).mean(dim=-1)
    eye = torch.eye(3, dtype=rate.dtype, device=rate.device)
    covariance = torch.linalg.inv(information + least[:, None, None] * eye)

    views = torch.bincount(point, minlength=count).double()
    freedom = (2 * views - 3).clamp_min(1)
    error = scene.reprojection_errors_px.double()
    noise = 2 / torch.pi * error.square() * 2 * views / freedom
    common = noise.median()
    blended = (_COMMON_FREEDOM * common + freedom * noise) / (_COMMON_FREEDOM + freedom)
    return (blended[index, None, None] * covariance).to(scene.points_world)
