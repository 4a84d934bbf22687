"""Checks of photographs before a run: of each alone, and of what all show in common."""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median

from pimper_torch.doctor.cost import cost
from pimper_torch.doctor.findings import Finding, ok, warned
from pimper_torch.doctor.machine import available_gb
from pimper_torch.doctor.pairs import light, match_copies, overlap, variations
from pimper_torch.doctor.photograph import Photograph, of_views, read_all
from pimper_torch.errors import InputError, some
from pimper_torch.io.decode import read_header
from pimper_torch.io.header import Header
from pimper_torch.io.photographs import MIN_PHOTOGRAPHS, list_images
from pimper_torch.io.responses import find_cautions, responses_told
from pimper_torch.radiometry import FROM_FILES, Encoding
from pimper_torch.records import Views
from pimper_torch.sfm.lenses import group_lenses

# 24 photographs of the demo and rendered scenes are within these and the other limits.
_BLUR_PX, _BLUR_RATIO = 1.5, 1.6  # absolute, and beside the median of the folder


def examine_folder(
    folder: Path | str, encoding: Encoding = FROM_FILES, max_size_px: int = 0
) -> list[Finding]:
    """Examine the photographs of a folder, in seconds.

    Returns:
        Of files, samples, number, blur, saturation, exposure, lenses, overlap, light and cost.

    Raises:
        InputError: No such folder, or no images in it.
    """
    paths = list_images(folder)
    read = read_all(paths, encoding, max_size_px)
    photographs = [one for one in read if isinstance(one, Photograph)]
    findings = [
        Finding(check="files", severity="error", found=str(error).rstrip("."))
        for error in read
        if isinstance(error, InputError)
    ]
    matches = match_copies([one.small for one in photographs])
    return [
        *findings,
        *samples(paths, encoding),
        *each_alone(photographs),
        *overlap([one.name for one in photographs], matches),
        *light(variations(photographs, matches)),
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
    if len(sizes) == 1:
        told = told.split(" of ")[1] + " each"
    found = f"{len(photographs)} photographs, {told}, {megapixels:.0f} megapixels"
    if len(photographs) < MIN_PHOTOGRAPHS:
        advice = "Take 20 to 40 round the object, each under another position of the light."
        yield warned("number", found, f"{MIN_PHOTOGRAPHS} at least", advice, "error")
    elif len(photographs) < 8:
        advice = "Normals come from at least 4 lights on every part. Take more photographs."
        yield warned("number", found, "8 or more", advice)
    else:
        yield ok("number", found)


def blur(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Find photographs that are blurred, in pixels and beside the others."""
    known = [one for one in photographs if not math.isnan(one.blur_px)]
    if not known:
        return
    usual = median(one.blur_px for one in known)
    limit = max(_BLUR_PX, _BLUR_RATIO * usual)
    blurred = [f"{one.name} ({one.blur_px:.1f} px)" for one in known if one.blur_px > limit]
    if blurred:
        yield warned(
            "blur",
            f"{len(blurred)} of {len(photographs)} are blurred: {some(blurred, 4)}",
            f"edges of at most {limit:.1f} px, the median being {usual:.1f}",
            "Take them again from a tripod or with a shorter exposure, or leave them out.",
        )
    elif usual > _BLUR_PX:
        yield warned(
            "blur",
            f"all are blurred, by {usual:.1f} px in the median",
            f"{_BLUR_PX:g} px or less",
            "`--max-size-px` of half their size loses no detail, and a run takes a quarter of the "
            "time.",
            "note",
        )
    else:
        amount = f"{usual:.1f} px" if usual >= 0.5 else "less than 0.5 px"
        yield ok("blur", f"sharp, edges blurred by {amount} in the median")


def saturation(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Find photographs of which much is saturated."""
    burnt = [f"{one.name} ({one.saturated:.0%})" for one in photographs if one.saturated > 0.05]
    most = max((one.saturated for one in photographs), default=0.0)
    if not burnt:
        yield ok("saturation", f"at most {most:.1%} of a photograph saturated")
        return
    yield warned(
        "saturation",
        f"{len(burnt)} of {len(photographs)} are saturated in part: {some(burnt, 4)}",
        "5% of the pixels at most",
        "Saturated pixels tell no light. Expose less, or darken a white background.",
    )


def exposure(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Find photographs that are dark all over."""
    dark = [f"{one.name} ({one.bright:.1%})" for one in photographs if one.bright < 0.05]
    if dark:
        yield warned(
            "exposure",
            f"{len(dark)} of {len(photographs)} are dark, brightest parts in per cent of "
            f"saturation: {some(dark, 4)}",
            "5% or more",
            "Expose longer: noise takes the place of shading.",
        )
    elif photographs:
        bright = median(one.bright for one in photographs)
        yield ok("exposure", f"brightest parts at {bright:.0%} of saturation in the median")


def lenses(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Group photographs by size and focal length, as each lens is found for itself."""
    numbers = group_lenses(
        [(max(one.width, one.height), min(one.width, one.height)) for one in photographs],
        [one.focal_px for one in photographs],
    )
    if not numbers:
        return
    counts = sorted(Counter(numbers).items())
    firsts = [photographs[numbers.index(lens)] for lens, _ in counts]
    told = "; ".join(
        f"{count} of {one.width}x{one.height}"
        + ("" if math.isnan(one.focal_px) else f" at {one.focal_px:.0f} px")
        for (_, count), one in zip(counts, firsts, strict=True)
    )
    several = len(counts) > 1
    what = f"{len(counts)} lenses, focal lengths or formats" if several else "one lens"
    if several and min(count for _, count in counts) < 3:
        yield warned(
            "lenses",
            f"{what}: {told}",
            "3 photographs or more of each, as each is found for itself",
            "Crop and zoom no more, or give `--reconstruct.shared-camera` if it is one lens "
            "whatever EXIF says.",
        )
    elif any(math.isnan(one.focal_px) for one in photographs):
        advice = "It is found from the photographs then; keep EXIF where you can."
        yield warned("lenses", f"{what}: {told}", "EXIF with the focal length", advice, "note")
    else:
        yield Finding(check="lenses", severity="note" if several else "ok", found=f"{what}: {told}")


def samples(paths: Sequence[Path | str], encoding: Encoding) -> Iterator[Finding]:
    """Report the response of the files that can be read, and warn of what is not followed."""
    read = [(path, header) for path in paths if (header := _header(path)) is not None]
    if not read:
        return
    named, headers = zip(*read, strict=True)
    cautions = find_cautions(named, headers, encoding)
    for sentence, names in cautions.items():
        yield Finding(
            check="samples",
            severity="warning",
            found=f"{len(names)} of {len(headers)} photographs ({some(names, 4)}): {sentence}",
        )
    if not cautions:
        given = encoding.response
        taken = f"{given}, as given"
        if given == "auto":
            counts = responses_told(headers)
            taken = "; ".join(f"{what} ({count})" for what, count in counts.items())
        yield ok("samples", f"response {taken}")


def _header(path: Path | str) -> Header | None:
    try:
        return read_header(path)
    except InputError:
        return None
