"""The real size of a result, from lengths and markers."""

from collections.abc import Sequence
from typing import Literal

import torch

from pimper_torch.doors.scale.given import CameraDistance, ScaleBar, Unit
from pimper_torch.doors.scale.marker_scale import scale_of_markers
from pimper_torch.doors.scale.marks import place_of, view_of
from pimper_torch.doors.scale.scale import Length, Scale, fitted, most_accurate
from pimper_torch.ground.shapes import Vector
from pimper_torch.records import Reconstruction
from pimper_torch.runtime.errors import caution


def scale_of_bars(result: Reconstruction, bars: Sequence[ScaleBar], unit: Unit = "mm") -> Scale:
    """Find the scale of a result from places that are known distances apart."""
    lengths = [_length([place_of(mark, result) for mark in bar.ends], bar) for bar in bars]
    return fitted(lengths, unit, "scale bars")


def scale_of_cameras(
    result: Reconstruction, distances: Sequence[CameraDistance], unit: Unit = "mm"
) -> Scale:
    """Find the scale of a result from cameras that are known distances apart."""
    centers = result.cameras.detach().to("cpu", torch.float64).centers_world
    lengths = [
        _length([centers[view_of(name, result.scene)] for name in (one.first, one.second)], one)
        for one in distances
    ]
    return fitted(lengths, unit, "camera distances")


def _length(ends: Sequence[Vector], given: ScaleBar | CameraDistance) -> Length:
    found = float((ends[0] - ends[1]).norm())
    return Length(found=found, known=given.length, what=f"{given.first} to {given.second}")


def find_scale(
    result: Reconstruction,
    *,
    bars: Sequence[ScaleBar] = (),
    camera_distances: Sequence[CameraDistance] = (),
    markers: Literal["auto", "off"] | float = "auto",
    unit: Unit = "mm",
    own_frame: bool = False,
) -> Scale | None:
    """Find what a result's lengths have to be multiplied by to be in a known unit.

    :func:`~pimper_torch.doors.scale.scaled.scaled` multiplies them.

    The most accurate of what is given counts: scale bars, else markers, else camera distances.
    A warning names those that differ from it by more than 2 %.

    Args:
        bars: Places that are known distances apart.
        markers: Whether markers of ``pimper markers`` are looked for, and the length of their
            sides in millimetres, if it is not what their numbers say.
        own_frame: The cameras came with the photographs, in a unit of their own, which markers of
            which nothing was said do not change.

    Returns:
        ``None`` where the size is not known.
    """
    scales = []
    if bars:
        scales.append(scale_of_bars(result, bars, unit))
    if camera_distances:
        scales.append(scale_of_cameras(result, camera_distances, unit))
    side_mm = None if isinstance(markers, str) else float(markers)
    if markers != "off" and (side_mm is not None or scales or not own_frame):
        found = scale_of_markers(result.scene, side_mm, unit)
        if found is not None:
            scales.append(found)
        elif side_mm is not None:
            caution(
                "No marker was found that two photographs show alike. Print a sheet (`pimper "
                "markers`), lay it flat beside the object, and photograph both sharply, not "
                "overexposed."
            )
    return most_accurate(scales)
