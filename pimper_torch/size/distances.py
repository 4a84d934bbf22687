"""Scales from lengths that a person knows: between places, or between cameras."""

from collections.abc import Sequence

import torch

from pimper_torch.records import Reconstruction
from pimper_torch.size.given import CameraDistance, ScaleBar, Unit
from pimper_torch.size.marks import place_of, view_of
from pimper_torch.size.scale import Length, Scale, fitted


def scale_of_bars(result: Reconstruction, bars: Sequence[ScaleBar], unit: Unit = "mm") -> Scale:
    """Find the scale of a result from places that are known distances apart.

    Args:
        bars: One at least.

    Raises:
        InputError: A place cannot be found, see :func:`~pimper_torch.size.marks.place_of`.
    """
    lengths = [
        Length(
            found=float((place_of(bar.first, result) - place_of(bar.second, result)).norm()),
            known=bar.length,
            what=f"{bar.first} to {bar.second}",
        )
        for bar in bars
    ]
    return fitted(lengths, unit, "scale bars")


def scale_of_cameras(
    result: Reconstruction, distances: Sequence[CameraDistance], unit: Unit = "mm"
) -> Scale:
    """Find the scale of a result from cameras that are known distances apart.

    Args:
        distances: One at least.

    Raises:
        InputError: A photograph has no camera.
    """
    centers = result.cameras.detach().to("cpu", torch.float64).centers_world
    lengths = []
    for one in distances:
        first, second = (centers[view_of(name, result.scene)] for name in (one.first, one.second))
        found = float((first - second).norm())
        lengths.append(Length(found=found, known=one.length, what=f"{one.first} to {one.second}"))
    return fitted(lengths, unit, "camera distances")
