"""Projection matrices to cameras."""

import numpy as np
import scipy.linalg
import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.geometry.rigid import rigid


def decompose_projections(
    projections: Float[Tensor, "view 3 4"],
) -> tuple[Float[Tensor, "view 3 3"], Float[Tensor, "view 4 4"]]:
    r"""Split ``P ~ K [R | t]`` into intrinsics and ``cam_from_world``.

    ``P`` is known up to a factor, negative ones included. The left 3x3 block is an upper
    triangular matrix times an orthogonal one (RQ); that ``K`` has a positive diagonal and
    ``R`` is a rotation makes the split unique. What the cameras project stays exactly the
    same, also where a file's ``R`` was not orthogonal: the rest goes into ``K``.

    Args:
        projections: World to pixels.

    Returns:
        ``K`` with ``K[2, 2] = 1``, its skew kept, and rigid transforms; float64.

    Raises:
        ValueError: A left block without inverse, the matrix of no finite camera.

    Source: Hartley & Zisserman, Multiple View Geometry, 2nd edition, section 6.2.4.
    """
    intrinsics, poses = [], []
    for matrix in projections.detach().cpu().double().numpy():
        left = matrix[:, :3]
        determinant = float(np.linalg.det(left))
        size = float(np.linalg.norm(left))
        # Rows of K [R | t] differ by the focal length in pixels, cubes of it at most.
        if not np.isfinite(size) or abs(determinant) <= 1e-13 * size**3:
            raise ValueError("the left 3x3 block has no inverse")
        proper = matrix if determinant > 0 else -matrix
        K, R = scipy.linalg.rq(proper[:, :3])
        signs = np.where(np.diag(K) < 0, -1.0, 1.0)
        K, R = K * signs, signs[:, None] * R
        intrinsics.append(torch.from_numpy(K / K[2, 2]))
        translation = torch.from_numpy(np.linalg.solve(K, proper[:, 3]))
        poses.append(rigid(torch.from_numpy(R), translation))
    return torch.stack(intrinsics), torch.stack(poses)
