"""Everything that can be told of photographs before a run."""

from pathlib import Path

from pimper_torch.doctor.cost import cost
from pimper_torch.doctor.each import each_alone
from pimper_torch.doctor.findings import Finding
from pimper_torch.doctor.light import light, variations
from pimper_torch.doctor.machine import available_gb
from pimper_torch.doctor.overlap import match_copies, overlap
from pimper_torch.doctor.photograph import Photograph, of_views, read_all
from pimper_torch.doctor.samples import samples
from pimper_torch.errors import InputError
from pimper_torch.io.photographs import list_images
from pimper_torch.radiometry import FROM_FILES, Encoding
from pimper_torch.records import Views


def examine_folder(
    folder: Path | str, encoding: Encoding = FROM_FILES, max_size_px: int = 0
) -> list[Finding]:
    """Examine the photographs of a folder, in seconds.

    Args:
        encoding: As of :func:`pimper_torch.io.photographs.load_views`.

    Returns:
        In the order of the checks: files, samples, number, blur, saturation, exposure, lenses,
        overlap, light, cost.

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
