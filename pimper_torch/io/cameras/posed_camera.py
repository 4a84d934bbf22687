"""A camera of a file: pose, lens and name of its photograph."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.geometry.rigid import rigid
from pimper_torch.records import CameraModel, Record
from pimper_torch.records.shapes import Pose, Poses

Rig = tuple[Float[Tensor, "view 3 3"], Poses]
"""Intrinsics and ``cam_from_world``."""
Distortion = tuple[str, tuple[float, ...]]
"""COLMAP's name of a lens model, and its parameters after those of ``K``."""
SizesOf = Callable[[Sequence[str]], Sequence[tuple[int, int] | None]]
"""Returns width and height of photographs by their names in a file; ``None`` if missing."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PosedCamera(Record):
    """One camera of a file.

    Attributes:
        name: Name or path of its photograph in the file.
        cam_from_world: Rigid, in float64; camera axes x right, y down, z forward.
        lens: In our pixels (centre of the top-left pixel at (0.5, 0.5)), for its own image size.
    """

    name: str
    cam_from_world: Pose
    lens: CameraModel
    skew_px: float = 0.0


def number_lenses(cameras: Sequence[PosedCamera]) -> list[PosedCamera]:
    """Number the lenses from 1, with the same number for equal lenses."""
    lenses = list(dict.fromkeys(camera.lens for camera in cameras))
    return [
        camera.replace(lens=camera.lens.replace(camera=1 + lenses.index(camera.lens)))
        for camera in cameras
    ]


def opencv_lens(k1: float, k2: float, p1: float, p2: float, *others: float) -> Distortion:
    """Return COLMAP's model of an OpenCV distortion; ``PINHOLE`` if all parameters are 0.

    Args:
        others: ``k3`` to ``k6``, of which the last ones may be missing.
    """
    params = (k1, k2, p1, p2, *others, *[0.0] * (4 - len(others)))
    return ("FULL_OPENCV", params) if any(params) else ("PINHOLE", ())


def decompose_projections(projections: Float[Tensor, "view 3 4"]) -> Rig:
    r"""Split ``P ~ K [R | t]`` into intrinsics and ``cam_from_world``.

    ``P`` is known up to a factor, which may be negative. The left 3x3 block is an upper
    triangular matrix times an orthogonal one (RQ). The split is unique, as the diagonal of ``K``
    is positive and ``R`` is a rotation. Projections stay the same, even if ``R`` in the file was
    not orthogonal: the remainder becomes part of ``K``.

    Returns:
        ``K`` with ``K[2, 2] = 1``, including skew, and rigid transforms; float64.

    Raises:
        ValueError: A left block has no inverse, so the camera is not finite.

    Source: Hartley & Zisserman, Multiple View Geometry, 2nd edition, section 6.2.4.
    """
    intrinsics, poses = [], []
    for index, matrix in enumerate(projections.detach().cpu().double().numpy()):
        left = matrix[:, :3]
        determinant = float(np.linalg.det(left))
        size = float(np.linalg.norm(left))
        # Rows of K [R | t] differ by factors of the focal length in pixels, at most its cube.
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
