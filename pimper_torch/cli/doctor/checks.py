"""Checks of photographs before a run: of each alone, and of what all show in common."""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median

from pimper_torch.cli.doctor.cost import cost
from pimper_torch.cli.doctor.findings import Finding
from pimper_torch.cli.doctor.machine import available_gb
from pimper_torch.cli.doctor.pairs import match_copies, overlap
from pimper_torch.cli.doctor.photograph import Photograph, of_views
from pimper_torch.doors.io.photographs import load_views
from pimper_torch.ground.radiometry import FROM_FILES, Encoding
from pimper_torch.method.sfm.lenses import group_lenses
from pimper_torch.records import Views
from pimper_torch.runtime.errors import some

# 24 photographs of the demo and rendered scenes are within these and the other limits.
_BLUR_PX, _BLUR_RATIO = 1.5, 1.6  # absolute, and beside the median of the folder


def examine_folder(
    folder: Path | str, encoding: Encoding = FROM_FILES, max_size_px: int = 0
) -> list[Finding]:
    """Examine the photographs of a folder, in seconds.

    Returns:
        Of number, blur, saturation, exposure, lenses, overlap and cost.

    Raises:
        InputError: As of :func:`pimper_torch.doors.io.photographs.load_views`.
    """
    photographs = of_views(load_views(folder, encoding=encoding, max_size_px=max_size_px))
    matches = match_copies([one.small for one in photographs])
    return [
        *each_alone(photographs),
        *overlap([one.name for one in photographs], matches),
        *cost(photographs, available_gb()),
    ]


def examine_views(views: Views) -> list[Finding]:
    """Examine photographs that were read, without comparing what they show."""
    photographs = of_views(views)
    return [*each_alone(photographs), *cost(photographs, available_gb())]


def each_alone(photographs: Sequence[Photograph]) -> list[Finding]:
    """Check photographs without comparing what they show."""
    checks = (number, blur, saturation, exposure, lenses)
    return [finding for check in checks for finding in check(photographs)]


def number(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Report how many there are, and of which sizes."""
    sizes = Counter((one.width, one.height) for one in photographs)
    megapixels = sum(one.width * one.height for one in photographs) / 1e6
    told = ", ".join(f"{count} of {w}x{h}" for (w, h), count in sizes.most_common(3))
    found = f"{len(photographs)} photographs, {told}, {megapixels:.0f} megapixels"
    if len(photographs) < 8:
        advice = "Normals come from at least 4 lights on every part. Take more photographs."
        yield Finding("number", "warning", found, "8 or more", advice)
    else:
        yield Finding("number", "ok", found)


def blur(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Find photographs that are blurred, in pixels and beside the others."""
    known = [one for one in photographs if not math.isnan(one.blur_px)]
    if not known:
        return
    usual = median(one.blur_px for one in known)
    limit = max(_BLUR_PX, _BLUR_RATIO * usual)
    blurred = [f"{one.name} ({one.blur_px:.1f} px)" for one in known if one.blur_px > limit]
    if blurred:
        found = f"{len(blurred)} of {len(photographs)} are blurred: {some(blurred, 4)}"
        needed = f"edges of at most {limit:.1f} px, the median being {usual:.1f}"
        advice = "Take them again from a tripod or with a shorter exposure, or leave them out."
        yield Finding("blur", "warning", found, needed, advice)
    elif usual > _BLUR_PX:
        found = f"all are blurred, by {usual:.1f} px in the median"
        advice = "`--max-size-px` of half their size loses no detail, in a quarter of the time."
        yield Finding("blur", "note", found, f"{_BLUR_PX:g} px or less", advice)
    else:
        yield Finding("blur", "ok", f"sharp, edges blurred by {usual:.1f} px in the median")


def saturation(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Find photographs of which much is saturated."""
    burnt = [f"{one.name} ({one.saturated:.0%})" for one in photographs if one.saturated > 0.05]
    if burnt:
        found = f"{len(burnt)} of {len(photographs)} are saturated in part: {some(burnt, 4)}"
        advice = "Saturated pixels tell no light. Expose less, or darken a white background."
        yield Finding("saturation", "warning", found, "5% of the pixels at most", advice)
    else:
        most = max(one.saturated for one in photographs)
        yield Finding("saturation", "ok", f"at most {most:.1%} of a photograph saturated")


def exposure(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Find photographs that are dark all over."""
    dark = [f"{one.name} ({one.bright:.1%})" for one in photographs if one.bright < 0.05]
    if dark:
        found = (
            f"the brightest parts of {len(dark)} of {len(photographs)} are dark: {some(dark, 4)}"
        )
        advice = "Expose longer: noise takes the place of shading."
        yield Finding("exposure", "warning", found, "5% of saturation or more", advice)
    else:
        bright = median(one.bright for one in photographs)
        told = f"brightest parts at {bright:.0%} of saturation in the median"
        yield Finding("exposure", "ok", told)


def lenses(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Group photographs by size and focal length, as each lens is found for itself."""
    numbers = group_lenses(
        [(max(one.width, one.height), min(one.width, one.height)) for one in photographs],
        [one.focal_px for one in photographs],
    )
    groups = []
    for lens, count in sorted(Counter(numbers).items()):
        one = photographs[numbers.index(lens)]
        focal = "unknown" if math.isnan(one.focal_px) else f"{one.focal_px:.0f} px"
        groups.append((count, f"{count} of {one.width}x{one.height}, focal length {focal}"))
    several = len(groups) > 1
    what = f"{len(groups)} lenses, focal lengths or formats" if several else "one lens"
    found = f"{what}: {'; '.join(told for _, told in groups)}"
    if several and min(count for count, _ in groups) < 3:
        needed = "3 photographs or more of each, as each is found for itself"
        advice = "Crop and zoom no more, or give `--reconstruct.shared-camera` if it is one lens."
        yield Finding("lenses", "warning", found, needed, advice)
    elif any(math.isnan(one.focal_px) for one in photographs):
        advice = "It is found from the photographs then; keep EXIF where you can."
        yield Finding("lenses", "note", found, "EXIF with the focal length", advice)
    else:
        yield Finding("lenses", "note" if several else "ok", found)
