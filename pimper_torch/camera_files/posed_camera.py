"""A camera as a file has it: pose, lens and what its photograph is called."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.camera_files.layout import DataSetPath
from pimper_torch.geometry.rigid import rigid
from pimper_torch.records import Lens, Record

# Files round a rotation to some digits; more than this is a scale or a reflection.
_MAX_FROM_ROTATION = 1e-2

SizesOf = Callable[[Sequence[str]], Sequence[tuple[int, int] | None]]
"""Width and height of photographs by their names in a file; ``None`` for those not there."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PosedCamera(Record):
    """One camera of a file.

    Attributes:
        name: Of its photograph, or path, as the file has it.
        cam_from_world: Rigid, in float64; camera axes x right, y down, z forward.
        lens: In our pixels (top-left centre at (0.5, 0.5)), for a size of its own.
        skew_px: ``K[0, 1]``.
    """

    name: str
    cam_from_world: Float[Tensor, "4 4"]
    lens: Lens
    skew_px: float = 0.0


def number_lenses(cameras: Sequence[PosedCamera]) -> list[PosedCamera]:
    """Let cameras share a lens's number where their lenses are equal."""
    lenses = list(dict.fromkeys(camera.lens for camera in cameras))
    return [
        camera.replace(lens=camera.lens.replace(camera=1 + lenses.index(camera.lens)))
        for camera in cameras
    ]


def pinhole_lens(intrinsics: Float[Tensor, "3 3"], size_px: tuple[int, int]) -> Lens:
    """Return the lens of a pinhole's ``K``, but for its skew."""
    K = intrinsics.tolist()
    params = (K[0][0], K[1][1], K[0][2], K[1][2])
    return Lens(camera=1, model="PINHOLE", params=params, width=size_px[0], height=size_px[1])


def rigid_or_refuse(
    rotation: Float[Tensor, "3 3"], translation: Float[Tensor, "3"], what: str, file: DataSetPath
) -> Float[Tensor, "4 4"]:
    """Put a file's rotation and translation together, the rotation made exact.

    Raises:
        InputError: The matrix is further from a rotation than rounding explains.
    """
    U, _, Vh = torch.linalg.svd(rotation)
    nearest = U @ Vh
    off = float((rotation - nearest).abs().max())
    mirrored = bool(torch.linalg.det(nearest) < 0)
    found = "a reflection" if mirrored else f"a matrix that is {off:.2g} off the nearest rotation"
    file.expect(off <= _MAX_FROM_ROTATION and not mirrored, f"a rotation in {what}", found)
    return rigid(nearest, translation)
