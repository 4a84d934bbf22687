"""Checks of photographs: each one alone, and their overlap."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from statistics import median

from pimper_torch.cli.doctor.cost import cost
from pimper_torch.cli.doctor.findings import Finding, available_gb
from pimper_torch.cli.doctor.pairs import match_copies, overlap
from pimper_torch.cli.doctor.photograph import Photograph, summarize_views
from pimper_torch.records import Views
from pimper_torch.runtime.errors import some

# The demo's photographs and rendered scenes satisfy these and the other limits.
_BLUR_PX, _BLUR_RATIO = 1.5, 1.6  # absolute, and relative to the median of the folder


def examine_views(
    views: Views,
    sizes_px: Mapping[str, tuple[int, int]] | None = None,
    *,
    together: bool = False,
    shrunk: str = "",
) -> list[Finding]:
    """Check photographs, in seconds: number, blur, saturation, exposure and cost.

    Args:
        sizes_px: Width and height in the run by name; by default those of the views.
        together: Also check their overlap.
        shrunk: Clause on the working size, for the cost.
    """
    photographs = summarize_views(views, sizes_px)
    alone = (check(photographs) for check in (number, blur, saturation, exposure))
    findings = [finding for finding in alone if finding is not None]
    if together:
        matches = match_copies([photo.small for photo in photographs])
        findings.append(overlap(views.names, matches))
    return [*findings, cost(photographs, available_gb(), shrunk)]


def number(photographs: Sequence[Photograph]) -> Finding:
    """Report the number and the sizes of the photographs."""
    counts = Counter((photo.width, photo.height) for photo in photographs)
    megapixels = sum(photo.width * photo.height for photo in photographs) / 1e6
    sizes = ", ".join(f"{count} of {w}x{h}" for (w, h), count in counts.most_common(3))
    found = f"{len(photographs)} photographs, {sizes}, {megapixels:.0f} megapixels"
    if len(photographs) >= 8:
        return Finding("number", "ok", found)
    advice = "Normals need at least 4 lights at every point. Take more photographs."
    return Finding("number", "warning", found, "8 or more", advice)


def blur(photographs: Sequence[Photograph]) -> Finding | None:
    """Report blurred photographs, in pixels and relative to the median."""
    measured = [photo for photo in photographs if not math.isnan(photo.blur_px)]
    if not measured:
        return None
    usual = median(photo.blur_px for photo in measured)
    limit = max(_BLUR_PX, _BLUR_RATIO * usual)
    blurred = [f"{p.name} ({p.blur_px:.1f} px)" for p in measured if p.blur_px > limit]
    if blurred:
        found = f"{len(blurred)} of {len(photographs)} are blurred: {some(blurred, 4)}"
        needed = f"edges blurred by at most {limit:.1f} px (the median is {usual:.1f} px)"
        advice = "Retake them from a tripod or with a shorter exposure, or remove them."
        return Finding("blur", "warning", found, needed, advice)
    return Finding("blur", "ok", f"edges are blurred by {usual:.1f} px in the median")


def saturation(photographs: Sequence[Photograph]) -> Finding:
    """Report photographs with many saturated pixels."""
    bright = [f"{p.name} ({p.saturated:.0%})" for p in photographs if p.saturated > 0.05]
    if bright:
        found = f"{len(bright)} of {len(photographs)} are partly saturated: {some(bright, 4)}"
        advice = "Saturated pixels cannot be used. Expose less, or darken a white background."
        return Finding("saturation", "warning", found, "at most 5% of the pixels", advice)
    most = max(photo.saturated for photo in photographs)
    return Finding("saturation", "ok", f"at most {most:.1%} of a photograph saturated")


def exposure(photographs: Sequence[Photograph]) -> Finding:
    """Report photographs that are dark everywhere."""
    dark = [f"{p.name} ({p.bright:.1%})" for p in photographs if p.bright < 0.05]
    if dark:
        found = (
            f"the brightest parts of {len(dark)} of {len(photographs)} are dark: {some(dark, 4)}"
        )
        advice = "Expose longer: noise hides the shading."
        return Finding("exposure", "warning", found, "5% of saturation or more", advice)
    bright = median(photo.bright for photo in photographs)
    return Finding("exposure", "ok", f"brightest parts at {bright:.0%} of saturation in the median")
