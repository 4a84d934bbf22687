"""A camera as a file has it: pose, lens and what its photograph is called."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.ground.geometry.rigid import rigid
from pimper_torch.ground.shapes import Pose, Poses
from pimper_torch.records import CameraModel, Record

Rig = tuple[Float[Tensor, "view 3 3"], Poses]
"""Intrinsics and ``cam_from_world``."""
Distortion = tuple[str, tuple[float, ...]]
"""COLMAP's model of a lens, and its parameters after those of ``K``."""
SizesOf = Callable[[Sequence[str]], Sequence[tuple[int, int] | None]]
"""Width and height of photographs by their names in a file; ``None`` for those not there."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PosedCamera(Record):
    """One camera of a file.

    Attributes:
        name: Of its photograph, or path, as the file has it.
        cam_from_world: Rigid, in float64; camera axes x right, y down, z forward.
        lens: In our pixels (top-left centre at (0.5, 0.5)), for a size of its own.
    """

    name: str
    cam_from_world: Pose
    lens: CameraModel
    skew_px: float = 0.0


def number_lenses(cameras: Sequence[PosedCamera]) -> list[PosedCamera]:
    """Let cameras share a lens's number where their lenses are equal."""
    lenses = list(dict.fromkeys(camera.lens for camera in cameras))
    return [
        camera.replace(lens=camera.lens.replace(camera=1 + lenses.index(camera.lens)))
        for camera in cameras
    ]


def polynomial_lens(k1: float, k2: float, p1: float, p2: float, k3: float) -> Distortion:
    """Return OpenCV's distortion as a model of COLMAP; a pinhole without any."""
    params = (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    return ("FULL_OPENCV", params) if any(params) else ("PINHOLE", ())


def decompose_projections(projections: Float[Tensor, "view 3 4"]) -> Rig:
    r"""Split ``P ~ K [R | t]`` into intrinsics and ``cam_from_world``.

    ``P`` is known up to a factor, negative ones included. The left 3x3 block is an upper
    triangular matrix times an orthogonal one (RQ); that ``K`` has a positive diagonal and
    ``R`` is a rotation makes the split unique. What the cameras project stays exactly the
    same, also where a file's ``R`` was not orthogonal: the rest goes into ``K``.

    Returns:
        ``K`` with ``K[2, 2] = 1``, its skew kept, and rigid transforms; float64.

    Raises:
        ValueError: A left block without inverse, the matrix of no finite camera.

    Source: Hartley & Zisserman, Multiple View Geometry, 2nd edition, section 6.2.4.
    """
    intrinsics, poses = [], []
    for index, matrix in enumerate(projections.detach().cpu().double().numpy()):
        left = matrix[:, :3]
        determinant = float(np.linalg.det(left))
        size = float(np.linalg.norm(left))
        # Rows of K [R | t] differ by the focal length in pixels, cubes of it at most.
        if not np.isfinite(size) or abs(determinant) <= 1e-13 * size**3:
            raise ValueError(f"the left 3x3 block of number {index} has no inverse")
        proper = matrix if determinant > 0 else -matrix
        K, R = scipy.linalg.rq(proper[:, :3])
        signs = np.where(np.diag(K) < 0, -1.0, 1.0)
        K, R = K * signs, signs[:, None] * R
        intrinsics.append(torch.from_numpy(K / K[2, 2]))
        translation = torch.from_numpy(np.linalg.solve(K, proper[:, 3]))
        poses.append(rigid(torch.from_numpy(R), translation))
    return torch.stack(intrinsics), torch.stack(poses)
