"""Estimates of a run's time and memory."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from pimper_torch.cli.doctor.findings import Finding

if TYPE_CHECKING:
    from pimper_torch.cli.doctor.photograph import Photograph

# Lines through the runs of benchmarks/README.md, "Speed", with `default` on 2 cores: the demo (24
# photographs of 900x600, 13.0 megapixels in all) 112 s and 2.06 GB, the jar (30 of 1600x1200, 57.6
# megapixels) 364 s and 6.7 GB. Stages share the time as in runs of the jar, the mug and the demo,
# from 0.3 to 57.6 megapixels. Of the memory 64 bytes a pixel were photographs, which are on disk
# where they are large; what is left grows with the surface, and so with the pixels of one
# photograph: 1.2 GB for the demo, 3.0 for the jar. Depth maps take 7.3 MB a photograph
# (docs/decisions.md, "Photographs on disk").
_GB, _GB_A_MEGAPIXEL_OF_ONE, _GB_A_VIEW = 0.9, 1.25, 0.0073


def estimate(megapixels: float, num_views: int) -> tuple[float, float]:
    """Estimate seconds on 2 cores and GB of memory that ``default`` takes.

    >>> seconds, gigabytes = estimate(57.6, 30)
    >>> round(seconds), round(gigabytes, 2)
    (355, 3.3)
    """
    seconds = sum(seconds for _, seconds in planned(megapixels, num_views))
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
    """List the stages of the chain from coarse to fine with their estimated seconds on 2 cores.

    Compilation, next to nothing but for an installation's first run, is none of them. Stages that
    look at photographs grow with all pixels, those on the surface with the pixels of one, in the
    scale's square.
    """
    pairs, one = num_views * (num_views - 1) / 2, megapixels / max(1, num_views)
    found = 1.2 * megapixels + 0.05 * pairs
    stages = [
        ("reconstruct", 0.5 if cameras else found),
        ("silhouettes", 0.1 if masks else 4.0 + 0.35 * megapixels),
        ("contours", 0.3 + 0.1 * megapixels),
        ("coarse_surface", 3.8 + 0.25 * megapixels),
    ]
    for scale in scales:
        stages += [
            ("decompose", 0.1 + 3.0 * one * scale**2),
            ("light", 1.5),
            ("photometry", 1.6 * megapixels**0.75 * scale**2),
            ("fuse", 0.7 + 42.0 * one * scale**2),
            ("repair", 1.5 * one * scale**2),
        ]
    # Shares as of 30 photographs of 1600x1200, and of the demo.
    finish = [
        ("simplify", 0.5 * one),
        ("relight", 1.0 + 0.8 * one),
        ("texture", 0.3 + 1.7 * one),
        ("write", 1.7 + 2.0 * one),
    ]
    return [*stages, ("extract", 0.5 + 18.0 * one * scales[-1] ** 2), *finish]


def cost(photographs: Sequence["Photograph"], available_gb: float | None) -> Finding:
    """Report the estimate, and whether the memory is there."""
    megapixels = sum(one.width * one.height for one in photographs) / 1e6
    seconds, needed = estimate(megapixels, len(photographs))
    told = f"about {minutes(seconds)} on 2 cores and {needed:.1f} GB with `default`, an estimate"
    if available_gb is None or needed <= available_gb:
        return Finding("cost", "ok", told)
    found = f"{told}; {available_gb:.1f} GB are free"
    advice = "Shrink the photographs (`--max-size-px`), take fewer, or free memory."
    return Finding("cost", "warning", found, "as much memory as the run takes", advice)


def minutes(seconds: float) -> str:
    """Write a time that is estimated."""
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} minutes"
