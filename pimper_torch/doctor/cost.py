"""How long a run will take, and how much memory."""

from collections.abc import Iterator, Sequence

from pimper_torch.doctor.findings import Finding
from pimper_torch.doctor.photograph import Photograph

# Lines through the runs of benchmarks/README.md, "Speed", with `default` on 2 cores: the demo (24
# photographs of 900x600, 13.0 megapixels in all) 112 s and 2.06 GB, the jar (30 of 1600x1200, 57.6
# megapixels) 364 s and 6.7 GB. The jar at 800 pixels (14.4 megapixels) took 2.29 GB; the line says
# 2.2.
_SECONDS, _SECONDS_A_MEGAPIXEL = 40.0, 5.6
_GB, _GB_A_MEGAPIXEL = 0.7, 0.104


def estimate(megapixels: float) -> tuple[float, float]:
    """Estimate seconds on 2 cores and GB of memory that ``default`` takes.

    >>> estimate(57.6)
    (362.56, 6.6904)
    """
    return (
        _SECONDS + _SECONDS_A_MEGAPIXEL * megapixels,
        round(_GB + _GB_A_MEGAPIXEL * megapixels, 4),
    )


def cost(photographs: Sequence[Photograph], available_gb: float | None) -> Iterator[Finding]:
    """Tell the estimate, and whether the memory is there."""
    if not photographs:
        return
    megapixels = sum(one.width * one.height for one in photographs) / 1e6
    seconds, needed = estimate(megapixels)
    told = f"about {_minutes(seconds)} on 2 cores and {needed:.1f} GB with `default`, an estimate"
    if available_gb is None or needed <= available_gb:
        yield Finding(check="cost", severity="ok", found=told)
        return
    longest = max(max(one.width, one.height) for one in photographs)
    fits = max(0.0, (0.9 * available_gb - _GB) / _GB_A_MEGAPIXEL)
    size = int(longest * min(1.0, fits / megapixels) ** 0.5) // 50 * 50
    yield Finding(
        check="cost",
        severity="warning",
        found=f"{told}; {available_gb:.1f} GB are free",
        needed="as much memory as the run takes",
        advice=f"Give `--max-size-px {size}`, or fewer photographs."
        if size
        else "Free memory, or take fewer photographs.",
    )


def _minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} minutes"
