"""Which photographs were taken with one lens at one focal length, as their files say."""

import math
from collections.abc import Sequence

from pimper_torch.errors import InputError, some
from pimper_torch.records import Views
from pimper_torch.sfm.quarter_turns import QUARTERS

SAME_FOCAL = 0.02
"""Relative difference of focal lengths that EXIF rounds; a choice."""


def group_lenses(sizes: Sequence[tuple[int, int]], focals_px: Sequence[float]) -> list[int]:
    """Group photographs by size and focal length; either side up is one size.

    Photographs without a focal length are of the lens of their size, if that is one; else of a lens
    of their own.

    Args:
        focals_px: Focal length of each; NaN where it is not known.

    Returns:
        The group of each, numbered in the order of their first photographs.

    >>> group_lenses([(9, 6), (6, 9), (9, 6)], [10.0, 10.1, 15.0])
    [0, 0, 1]
    """
    shapes = [(max(size), min(size)) for size in sizes]
    known: dict[tuple[int, int], list[float]] = {}
    told = [one for one in zip(focals_px, shapes, strict=True) if not math.isnan(one[0])]
    for focal, shape in sorted(told):
        starts = known.setdefault(shape, [])
        if not (starts and focal <= (1 + SAME_FOCAL) * starts[-1]):
            starts.append(focal)
    numbers: dict[tuple[object, ...], int] = {}
    groups = []
    for focal, shape in zip(focals_px, shapes, strict=True):
        starts = known.get(shape, [])
        if math.isnan(focal):
            lens: object = 0 if len(starts) == 1 else None
        else:
            lens = sum(start <= focal for start in starts) - 1
        groups.append(numbers.setdefault((shape, lens), len(numbers)))
    return groups


def choose_lenses(views: Views, *, shared: bool = False, own: bool = False) -> list[int]:
    """Number the lenses of photographs that lie as their sensors do.

    Args:
        views: Photographs, see :func:`sensor_turns`.
    """
    if own:
        return list(range(views.num_views))
    sizes = [(width, height) for width, height in views.sizes_px.tolist()]
    if not shared:
        return group_lenses(sizes, views.focals_px.tolist())
    groups = {
        size: [name for name, its in zip(views.names, sizes, strict=True) if its == size]
        for size in dict.fromkeys(sizes)
    }
    if len(groups) > 1:
        found = "; ".join(
            f"{width}x{height}: {some(names)}" for (width, height), names in groups.items()
        )
        raise InputError(
            f"One shared camera was asked for, but the photographs have {len(groups)} sizes "
            f"({found}). Leave out `--reconstruct.shared-camera` (`shared_camera: true` in YAML), "
            "so that lenses are told apart by size and EXIF, or give photographs of one size."
        )
    return [0] * views.num_views


def sensor_turns(views: Views) -> tuple[int, ...]:
    """Find by how many clockwise quarters each photograph is turned from how its sensor lies.

    Sensors lie broadside; a photograph that stands upright beside others that lie is turned, by
    EXIF's orientation if it says so. Where all stand or all lie, none counts as turned.
    """
    sizes = [(width, height) for width, height in views.sizes_px.tolist()]
    if not any(width > height for width, height in sizes):
        return (0,) * views.num_views
    tags = [1] * views.num_views if views.orientations is None else views.orientations.tolist()
    return tuple(
        0 if width >= height else 3 if QUARTERS.get(tag) == 3 else 1
        for (width, height), tag in zip(sizes, tags, strict=True)
    )
