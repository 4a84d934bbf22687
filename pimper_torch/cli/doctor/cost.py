"""Estimates of the time and memory of a run."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from pimper_torch.cli.doctor.findings import Finding, available_gb

if TYPE_CHECKING:
    from pimper_torch.cli.doctor.photograph import Photograph

DETAIL_PX = 1600
"""Longer side to which a run shrinks larger photographs (docs/decisions.md, "The working size")."""
# Choices: sizes if memory is short, in steps, so that a little more of it changes nothing; and the
# share of the free memory, as estimates are within a factor of 1.5.
_SIZES_PX, _SHARE_OF_FREE = range(DETAIL_PX, 500, -100), 0.6

# Fitted by hand to runs of `default` on 2 cores with 10 to 30 photographs of 0.3 to 1.9 megapixels,
# each within a factor of 1.5 (benchmarks/README.md, "How cost grows"). Memory grows with the
# surface, and therefore with the pixels of one photograph: large photographs are on disk. Depth
# maps take 7.3 MB per photograph (docs/decisions.md, "Photographs on disk").
_GB, _GB_A_MEGAPIXEL_OF_ONE, _GB_A_VIEW = 1.1, 0.75, 0.0073


def estimate(megapixels: float, num_views: int) -> tuple[float, float]:
    """Estimate the seconds on 2 cores and the GB of memory of ``default``.

    >>> seconds, gigabytes = estimate(57.6, 30)
    >>> round(seconds), round(gigabytes, 2)
    (296, 2.54)
    """
    # Outside of stages: imports, reading photographs, hashing and keeping records.
    seconds = 3.0 + 0.35 * megapixels + sum(time for _, time in planned(megapixels, num_views))
    surface = _GB_A_MEGAPIXEL_OF_ONE * megapixels / max(1, num_views)
    return seconds, _GB + max(surface, _GB_A_VIEW * num_views)


def planned(
    megapixels: float,
    num_views: int,
    scales: Sequence[float] = (0.25, 0.5, 1.0),
    *,
    cameras: bool = False,
    masks: bool = False,
) -> list[tuple[str, float]]:
    """List the stages of the default chain with their estimated seconds on 2 cores.

    Compilation, noticeable only in an installation's first run, is excluded. Stages on photographs
    grow with all pixels, or with the number of photographs if they scale them down; stages on the
    surface grow with the pixels of one photograph and the square of the scale.
    """
    pairs, one = num_views * (num_views - 1) / 2, megapixels / max(1, num_views)
    if num_views > 66:  # each is matched with its 20 most similar views, many pairs twice
        pairs = 14.0 * num_views
    stages = [
        ("reconstruct", 0.5 if cameras else 0.6 * megapixels + 0.025 * pairs + 0.55 * num_views),
        ("silhouettes", 0.1 if masks else 1.0 + 0.55 * num_views),
        ("contours", 0.3 + 0.15 * megapixels),
        ("coarse_surface", 3.0 + 0.85 * num_views),
        ("explain", 0.2),
        ("pyramids", 0.05 * megapixels),
    ]
    for scale in scales:
        stages += [
            ("decompose", 0.1 + 3.0 * one * scale**2),
            ("light", 1.8),
            ("depth_from_light", 0.1 * num_views if scale == scales[0] else 0.0),
            ("photometry", 1.5 + 0.65 * megapixels**0.75 * scale**2),
            ("fuse", 0.8 + 26.0 * one * scale**2),
            ("repair", 1.2 * one * scale**2),
            ("explain", 0.1 + 1.0 * one * scale**2 if scale != scales[-1] else 0.0),
        ]
    return [
        *((name, seconds) for name, seconds in stages if seconds),
        ("extract", 0.5 + 4.0 * one * scales[-1] ** 2),
        ("judge", 0.1 + 1.0 * one * scales[-1] ** 2),
        ("simplify", 2.5 * one),
        ("relight", 5.0 + 0.5 * one),
        ("texture", 2.0 + 4.0 * one),
        ("judge_textures", 0.035 * num_views),
        ("draw", 2.0 + 0.1 * num_views + 1.5 * one),
        ("write", 1.0 + 1.0 * one),
    ]


def megapixels_at(sizes_px: Sequence[tuple[int, int]], longest: int) -> float:
    """Return the megapixels of all photographs after shrinking to a longer side; 0 is their own."""
    factors = (min(1.0, longest / max(size)) if longest else 1.0 for size in sizes_px)
    return sum(w * h * by**2 for (w, h), by in zip(sizes_px, factors, strict=True)) / 1e6


def working_size(
    sizes_px: Sequence[tuple[int, int]], given: int | None, limit_gb: float = 0.0
) -> tuple[int, str]:
    """Return the longer side to which a run shrinks photographs, and a clause if it shrinks any.

    Args:
        sizes_px: Width and height of the photographs' files.
        given: The user's choice, which counts; 0 keeps all sizes. ``None`` chooses the largest
            size of at most :data:`DETAIL_PX` whose estimated memory is within the limit.
        limit_gb: Memory of the run; by default 60 % of the free memory.
    """
    longest = given
    if longest is None:
        limit = limit_gb or _SHARE_OF_FREE * (available_gb() or math.inf)
        limit = max(limit, estimate(0.0, len(sizes_px))[1])  # which no size lowers
        needed = ((each, megapixels_at(sizes_px, each)) for each in _SIZES_PX)
        fits = (each for each, pixels in needed if estimate(pixels, len(sizes_px))[1] <= limit)
        longest = next(fits, _SIZES_PX[-1])
    width, height = max(sizes_px, key=max)
    clause = f"photographs of up to {width}x{height} are shrunk to {longest} px (`--max-size-px`)"
    return longest, clause if 0 < longest < max(width, height) else ""


def cost(photographs: Sequence["Photograph"], free_gb: float | None, shrunk: str = "") -> Finding:
    """Report the estimates, whether the memory is free, and a clause on the working size."""
    megapixels = sum(photo.width * photo.height for photo in photographs) / 1e6
    seconds, needed = estimate(megapixels, len(photographs))
    found = f"about {minutes(seconds)} on 2 cores and {needed:.1f} GB with `default`, an estimate"
    found += f"; {shrunk}" if shrunk else ""
    if free_gb is None or needed <= free_gb:
        return Finding("cost", "ok", found)
    found += f"; {free_gb:.1f} GB are free"
    advice = "Shrink the photographs (`--max-size-px`), use fewer, or free memory."
    return Finding("cost", "warning", found, "memory for the run", advice)


def minutes(seconds: float) -> str:
    """Return an estimated time as text."""
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} minutes"
