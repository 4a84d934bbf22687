"""A camera of a file: pose, lens and name of its photograph."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pimper_torch.records import CameraModel, Record
from pimper_torch.records.shapes import Pose

Numbers = tuple[float, ...]
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


def opencv_lens(
    size_px: tuple[int, int], pinhole: Numbers, terms: Numbers = (), camera: int = 1
) -> CameraModel:
    """Return a lens of OpenCV: ``FULL_OPENCV``, or ``PINHOLE`` if all terms are 0.

    Args:
        pinhole: ``fx``, ``fy``, ``cx``, ``cy``.
        terms: ``k1``, ``k2``, ``p1``, ``p2``, ``k3`` to ``k6``; the last ones may be missing.
    """
    model, count = ("FULL_OPENCV", 8) if any(terms) else ("PINHOLE", 0)
    params, (width, height) = (*pinhole, *(*terms, *[0.0] * 8)[:count]), size_px
    return CameraModel(camera=camera, model=model, params=params, width=width, height=height)
