"""Groups of photographs with a common lens."""

import math
from collections.abc import Sequence

from pimper_torch.records import Views
from pimper_torch.runtime.errors import InputError, some


def group_lenses(sizes: Sequence[tuple[int, int]], focals_px: Sequence[float]) -> list[int]:
    """Group photographs by size and focal length.

    Photographs without a focal length have the lens of their size if it is the only one, and
    otherwise share a separate lens.

    Args:
        focals_px: Focal length of each; NaN if unknown.

    Returns:
        The group of each, numbered in the order of their first photographs.

    >>> group_lenses([(9, 6), (9, 6), (6, 9)], [10.0, 10.1, 10.0])
    [0, 0, 1]
    """
    starts_of: dict[tuple[int, int], list[float]] = {}
    pairs = [pair for pair in zip(focals_px, sizes, strict=True) if not math.isnan(pair[0])]
    for focal, size in sorted(pairs):
        starts = starts_of.setdefault(size, [])  # EXIF rounds by less than 2 %
        if not (starts and focal <= 1.02 * starts[-1]):
            starts.append(focal)
    numbers: dict[tuple[object, ...], int] = {}
    groups = []
    for focal, size in zip(focals_px, sizes, strict=True):
        starts = starts_of.get(size, [])
        if math.isnan(focal):
            lens: object = 0 if len(starts) == 1 else None
        else:
            lens = sum(start <= focal for start in starts) - 1
        groups.append(numbers.setdefault((size, lens), len(numbers)))
    return groups


def choose_lenses(views: Views, *, shared: bool = False, own: bool = False) -> list[int]:
    """Return the number of the lens of each photograph."""
    if own:
        return list(range(views.num_views))
    sizes = [(width, height) for width, height in views.sizes_px.tolist()]
    if not shared:
        return group_lenses(sizes, views.focals_px.tolist())
    groups = {
        size: [name for name, s in zip(views.names, sizes, strict=True) if s == size]
        for size in dict.fromkeys(sizes)
    }
    if len(groups) > 1:
        listed = "; ".join(
            f"{width}x{height}: {some(names)}" for (width, height), names in groups.items()
        )
        raise InputError(
            f"One shared camera was requested, but the photographs have {len(groups)} sizes "
            f"({listed}). Omit `--reconstruct.shared-camera` (`shared_camera: true` in YAML) to "
            "distinguish lenses by size and EXIF, or give photographs of one size."
        )
    return [0] * views.num_views
