"""What can be told of photographs one by one: number, size, blur, exposure, lens."""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from statistics import median

from pimper_torch.doctor.findings import Finding, listed
from pimper_torch.doctor.photograph import Photograph
from pimper_torch.io.photographs import MIN_PHOTOGRAPHS
from pimper_torch.sfm.lenses import group_lenses

# Choices, all of them; 24 photographs of the demo and rendered scenes are within.
_FEW = 8  # with fewer, hardly a facet is lit in enough views
_BLUR_PX, _BLUR_RATIO = 1.5, 1.6  # absolute, and beside the median of the folder
_SHARP_PX = 0.5  # as sharp as pixels are
_SATURATED = 0.05
_DARK = 0.05  # of saturation: in 8 bits of sRGB 63 levels are left
_FEW_OF_A_LENS = 3  # with fewer, its focal length is hardly told from its distance


def each_alone(photographs: Sequence[Photograph]) -> list[Finding]:
    """Check photographs without comparing what they show."""
    checks = (number, blur, saturation, exposure, lenses)
    return [finding for check in checks for finding in check(photographs)]


def number(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Report how many there are, and of which sizes."""
    sizes = Counter((one.width, one.height) for one in photographs)
    megapixels = sum(one.width * one.height for one in photographs) / 1e6
    told = ", ".join(f"{count} of {w}x{h}" for (w, h), count in sizes.most_common(3))
    if len(sizes) == 1:
        told = told.split(" of ")[1] + " each"
    found = f"{len(photographs)} photographs, {told}, {megapixels:.0f} megapixels"
    if len(photographs) < MIN_PHOTOGRAPHS:
        yield Finding(
            check="number",
            severity="error",
            found=found,
            needed=f"{MIN_PHOTOGRAPHS} at least",
            advice="Take 20 to 40 round the object, each under another position of the light.",
        )
    elif len(photographs) < _FEW:
        yield Finding(
            check="number",
            severity="warning",
            found=found,
            needed=f"{_FEW} or more",
            advice="Normals come from at least 4 lights on every part. Take more photographs.",
        )
    else:
        yield Finding(check="number", severity="ok", found=found)


def blur(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Find photographs that are blurred, in pixels and beside the others."""
    known = [one for one in photographs if not math.isnan(one.blur_px)]
    if not known:
        return
    usual = median(one.blur_px for one in known)
    limit = max(_BLUR_PX, _BLUR_RATIO * usual)
    blurred = [one for one in known if one.blur_px > limit]
    if blurred:
        names = [f"{one.name} ({one.blur_px:.1f} px)" for one in blurred]
        yield Finding(
            check="blur",
            severity="warning",
            found=f"{len(blurred)} of {len(photographs)} are blurred: {listed(names)}",
            needed=f"edges of at most {limit:.1f} px, the median being {usual:.1f}",
            advice="Take them again from a tripod or with a shorter exposure, or leave them out.",
        )
    elif usual > _BLUR_PX:
        yield Finding(
            check="blur",
            severity="note",
            found=f"all are blurred, by {usual:.1f} px in the median",
            needed=f"{_BLUR_PX:g} px or less",
            advice="`--max-size-px` of half their size loses no detail, and a run takes a quarter "
            "of the time.",
        )
    else:
        amount = f"{usual:.1f} px" if usual >= _SHARP_PX else f"less than {_SHARP_PX} px"
        found = f"sharp, edges blurred by {amount} in the median"
        yield Finding(check="blur", severity="ok", found=found)


def saturation(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Find photographs of which much is saturated."""
    burnt = [one for one in photographs if one.saturated > _SATURATED]
    most = max((one.saturated for one in photographs), default=0.0)
    if burnt:
        names = [f"{one.name} ({one.saturated:.0%})" for one in burnt]
        yield Finding(
            check="saturation",
            severity="warning",
            found=f"{len(burnt)} of {len(photographs)} are saturated in part: {listed(names)}",
            needed=f"{_SATURATED:.0%} of the pixels at most",
            advice="Saturated pixels tell no light. Expose less, or darken a white background.",
        )
    else:
        yield Finding(
            check="saturation", severity="ok", found=f"at most {most:.1%} of a photograph saturated"
        )


def exposure(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Find photographs that are dark all over."""
    dark = [one for one in photographs if one.bright < _DARK]
    if dark:
        names = [f"{one.name} ({one.bright:.1%})" for one in dark]
        yield Finding(
            check="exposure",
            severity="warning",
            found=f"{len(dark)} of {len(photographs)} are dark, brightest parts in per cent of "
            f"saturation: {listed(names)}",
            needed=f"{_DARK:.0%} or more",
            advice="Expose longer: noise takes the place of shading.",
        )
    elif photographs:
        bright = median(one.bright for one in photographs)
        yield Finding(
            check="exposure",
            severity="ok",
            found=f"brightest parts at {bright:.0%} of saturation in the median",
        )


def lenses(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Group photographs by size and focal length, as each lens is found for itself."""
    numbers = group_lenses(
        [(one.width, one.height) for one in photographs], [one.focal_px for one in photographs]
    )
    groups = [
        [one for one, number in zip(photographs, numbers, strict=True) if number == lens]
        for lens in range(len(set(numbers)))
    ]
    told = "; ".join(
        f"{len(group)} of {group[0].width}x{group[0].height}{_focal(group[0])}" for group in groups
    )
    guessed = any(math.isnan(one.focal_px) for one in photographs)
    few = [group for group in groups if len(group) < _FEW_OF_A_LENS]
    if len(groups) > 1 and few:
        yield Finding(
            check="lenses",
            severity="warning",
            found=f"{len(groups)} lenses, focal lengths or formats: {told}",
            needed=f"{_FEW_OF_A_LENS} photographs or more of each, as each is found for itself",
            advice="Crop and zoom no more, or give `--reconstruct.shared-camera` if it is one "
            "lens whatever EXIF says.",
        )
    elif groups:
        several = (
            f"{len(groups)} lenses, focal lengths or formats" if len(groups) > 1 else "one lens"
        )
        yield Finding(
            check="lenses",
            severity="note" if guessed or len(groups) > 1 else "ok",
            found=f"{several}: {told}",
            needed="EXIF with the focal length" if guessed else "",
            advice="It is found from the photographs then; keep EXIF where you can."
            if guessed
            else "",
        )


def _focal(one: Photograph) -> str:
    return "" if math.isnan(one.focal_px) else f" at {one.focal_px:.0f} px"
