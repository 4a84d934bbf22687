"""Checks of photographs before a run: of each alone, and of what all show in common."""

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from pimper_torch.cli.doctor.cost import cost
from pimper_torch.cli.doctor.findings import Finding, available_gb
from pimper_torch.cli.doctor.pairs import match_copies, overlap
from pimper_torch.cli.doctor.photograph import Photograph, of_views
from pimper_torch.doors.io.photographs import load_views
from pimper_torch.ground.radiometry import FROM_FILES, Encoding
from pimper_torch.records import Views
from pimper_torch.runtime.errors import some

# 24 photographs of the demo and rendered scenes are within these and the other limits.
_BLUR_PX, _BLUR_RATIO = 1.5, 1.6  # absolute, and relative to the median of the folder


def examine_folder(
    folder: Path | str, encoding: Encoding = FROM_FILES, max_size_px: int = 0
) -> list[Finding]:
    """Examine the photographs of a folder, in seconds.

    Returns:
        Of number, blur, saturation, exposure, overlap and cost.

    Raises:
        InputError: As of :func:`pimper_torch.doors.io.photographs.load_views`.
    """
    photographs = of_views(load_views(folder, encoding=encoding, max_size_px=max_size_px))
    matches = match_copies([one.small for one in photographs])
    return [
        *each_alone(photographs),
        overlap([one.name for one in photographs], matches),
        cost(photographs, available_gb()),
    ]


def examine_views(views: Views) -> list[Finding]:
    """Examine photographs that were read, without comparing what they show."""
    photographs = of_views(views)
    return [*each_alone(photographs), cost(photographs, available_gb())]


def each_alone(photographs: Sequence[Photograph]) -> list[Finding]:
    """Check photographs without comparing what they show."""
    found = [number(photographs), blur(photographs), saturation(photographs), exposure(photographs)]
    return [one for one in found if one is not None]


def number(photographs: Sequence[Photograph]) -> Finding:
    """Report how many there are, and of which sizes."""
    sizes = Counter((one.width, one.height) for one in photographs)
    megapixels = sum(one.width * one.height for one in photographs) / 1e6
    told = ", ".join(f"{count} of {w}x{h}" for (w, h), count in sizes.most_common(3))
    found = f"{len(photographs)} photographs, {told}, {megapixels:.0f} megapixels"
    if len(photographs) >= 8:
        return Finding("number", "ok", found)
    advice = "Normals come from at least 4 lights on every part. Take more photographs."
    return Finding("number", "warning", found, "8 or more", advice)


def blur(photographs: Sequence[Photograph]) -> Finding | None:
    """Find photographs that are blurred, in pixels and relative to the others."""
    known = [one for one in photographs if not math.isnan(one.blur_px)]
    if not known:
        return None
    usual = median(one.blur_px for one in known)
    limit = max(_BLUR_PX, _BLUR_RATIO * usual)
    blurred = [f"{one.name} ({one.blur_px:.1f} px)" for one in known if one.blur_px > limit]
    if blurred:
        found = f"{len(blurred)} of {len(photographs)} are blurred: {some(blurred, 4)}"
        needed = f"edges of at most {limit:.1f} px, the median being {usual:.1f}"
        advice = "Take them again from a tripod or with a shorter exposure, or leave them out."
        return Finding("blur", "warning", found, needed, advice)
    return Finding("blur", "ok", f"edges are blurred by {usual:.1f} px in the median")


def saturation(photographs: Sequence[Photograph]) -> Finding:
    """Find photographs of which much is saturated."""
    burnt = [f"{one.name} ({one.saturated:.0%})" for one in photographs if one.saturated > 0.05]
    if burnt:
        found = f"{len(burnt)} of {len(photographs)} are saturated in part: {some(burnt, 4)}"
        advice = "Saturated pixels tell no light. Expose less, or darken a white background."
        return Finding("saturation", "warning", found, "5% of the pixels at most", advice)
    most = max(one.saturated for one in photographs)
    return Finding("saturation", "ok", f"at most {most:.1%} of a photograph saturated")


def exposure(photographs: Sequence[Photograph]) -> Finding:
    """Find photographs that are dark all over."""
    dark = [f"{one.name} ({one.bright:.1%})" for one in photographs if one.bright < 0.05]
    if dark:
        found = (
            f"the brightest parts of {len(dark)} of {len(photographs)} are dark: {some(dark, 4)}"
        )
        advice = "Expose longer: noise takes the place of shading."
        return Finding("exposure", "warning", found, "5% of saturation or more", advice)
    bright = median(one.bright for one in photographs)
    return Finding("exposure", "ok", f"brightest parts at {bright:.0%} of saturation in the median")
