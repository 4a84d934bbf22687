"""Scale of a result from given lengths and printed markers."""

from collections.abc import Sequence
from typing import Literal

import torch

from pimper_torch.records import Reconstruction
from pimper_torch.records.shapes import Vector
from pimper_torch.runtime.errors import caution
from pimper_torch.runtime.torch_settings import isolated
from pimper_torch.scale.given import CameraDistance, ScaleBar, Unit
from pimper_torch.scale.marker_scale import Marker, scale_of_markers
from pimper_torch.scale.marks import place_of, view_of
from pimper_torch.scale.scale import Length, Scale, fit_scale, most_accurate


def scale_of_bars(result: Reconstruction, bars: Sequence[ScaleBar], unit: Unit = "mm") -> Scale:
    """Compute the scale of a result from points at known distances."""
    lengths = [_length([place_of(mark, result) for mark in bar.ends], bar) for bar in bars]
    return fit_scale(lengths, unit, "scale bars")


def scale_of_cameras(
    result: Reconstruction, distances: Sequence[CameraDistance], unit: Unit = "mm"
) -> Scale:
    """Compute the scale of a result from cameras at known distances."""
    centers = result.cameras.detach().to("cpu", torch.float64).centers_world
    lengths = [
        _length([centers[view_of(name, result.scene)] for name in (pair.first, pair.second)], pair)
        for pair in distances
    ]
    return fit_scale(lengths, unit, "camera distances")


def _length(ends: Sequence[Vector], given: ScaleBar | CameraDistance) -> Length:
    measured = float((ends[0] - ends[1]).norm())
    return Length(measured=measured, true=given.length, label=f"{given.first} to {given.second}")


@isolated
def find_scale(
    result: Reconstruction,
    *,
    bars: Sequence[ScaleBar] = (),
    camera_distances: Sequence[CameraDistance] = (),
    markers: Literal["auto", "off"] | float = "auto",
    unit: Unit = "mm",
    own_frame: bool = False,
    found: Sequence[Marker] | None = None,
) -> Scale | None:
    """Compute the factor from a result's lengths to a known unit.

    Apply it with :func:`~pimper_torch.scale.scaled.scaled`. The most accurate source is used:
    scale bars, else markers, else camera distances. A warning names sources that differ from it by
    more than 2 %.

    Args:
        bars: Pairs of points at known distances.
        markers: Whether to search for markers of ``pimper markers``; or the length of their sides
            in millimetres, if it differs from the one that their codes encode.
        own_frame: The cameras were given with the photographs. ``markers="auto"`` alone then does
            not change their unit.
        found: The markers of the scene; by default, they are searched for.

    Returns:
        ``None`` if the scale is unknown.
    """
    scales = []
    if bars:
        scales.append(scale_of_bars(result, bars, unit))
    if camera_distances:
        scales.append(scale_of_cameras(result, camera_distances, unit))
    side_mm = None if isinstance(markers, str) else float(markers)
    if markers != "off" and (side_mm is not None or scales or not own_frame):
        marker_scale = scale_of_markers(result.scene, side_mm, unit, found)
        if marker_scale is not None:
            scales.append(marker_scale)
        elif side_mm is not None:
            caution(
                "No marker was found at the same position in two photographs. Print a sheet "
                "(`pimper markers`), lay it flat next to the object, and photograph both in focus "
                "and not overexposed."
            )
    return most_accurate(scales)
