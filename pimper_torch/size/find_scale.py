"""The real size of a result, from whatever tells it."""

from collections.abc import Sequence
from typing import Literal

from pimper_torch.errors import caution
from pimper_torch.records import Reconstruction
from pimper_torch.size.distances import scale_of_bars, scale_of_cameras
from pimper_torch.size.given import CameraDistance, ScaleBar, Unit
from pimper_torch.size.marker_scale import scale_of_markers
from pimper_torch.size.scale import Scale, compare_with_units, most_accurate


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

    :func:`~pimper_torch.size.scaled.scaled` multiplies them.

    The most accurate of what is given counts: scale bars, else markers, else camera distances.
    Where another one differs by more than 2 %, a warning says so.

    Args:
        bars: Places that are known distances apart.
        markers: Whether markers of ``pimper markers`` are looked for, and the length of their
            sides in millimetres, if it is not what their numbers say.
        own_frame: The cameras came with the photographs, in a unit of their own. Markers of which
            nothing was said are then compared alone.

    Returns:
        ``None`` where nothing tells the size.

    Raises:
        InputError: A place or a photograph that is named cannot be found.
    """
    scales = []
    if bars:
        scales.append(scale_of_bars(result, bars, unit))
    if camera_distances:
        scales.append(scale_of_cameras(result, camera_distances, unit))
    asked = not isinstance(markers, str)
    if markers != "off":
        side_mm = float(markers) if not isinstance(markers, str) else None
        found = scale_of_markers(result.scene, side_mm, unit)
        if found is None and asked:
            caution(
                "No marker was found that two photographs show alike. Print a sheet (`pimper "
                "markers`), lay it flat beside the object, and photograph both sharply, not "
                "overexposed.",
            )
        elif found is not None and own_frame and not asked and not scales:
            compare_with_units(found)
        elif found is not None:
            scales.append(found)
    return most_accurate(scales)
