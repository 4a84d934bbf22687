"""``pimper gamma``: the response of photographs from a fixed camera under several lights."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from pimper_torch.cli.arguments import read_arguments
from pimper_torch.cli.output import Output
from pimper_torch.doors.io.photograph_files import list_images
from pimper_torch.ground.radiometry import LINEAR
from pimper_torch.runtime.errors import InputError, caution, held

if TYPE_CHECKING:
    from pimper_torch.single_view.factorization.estimate_gamma import GammaEstimate

# A standard response whose residual is below this multiple of the best is recommended: a choice.
_AS_GOOD = 1.05


def run(job: "_Job", output: Output) -> None:
    """Carry out ``gamma``: read, estimate, and print it with the option of `pimper reconstruct`."""
    from pimper_torch.doors.io.photographs import load_views, read_mask
    from pimper_torch.doors.io.responses import CONTRADICTED
    from pimper_torch.runtime.reporting import stage
    from pimper_torch.single_view.factorization.estimate_gamma import gamma_of_photographs

    with output.observer(), stage("read"), held() as messages:
        views = load_views(job.photos, encoding=LINEAR, max_size_px=job.max_size_px)
    for message in messages:
        if CONTRADICTED not in message:  # values are looked at as they are, whatever files say
            caution(message)
    drawn = None if job.mask is None else read_mask(job.mask, job.max_size_px)
    found = gamma_of_photographs(views, mask=drawn, rank=job.rank)
    output.emit(f"{found}{advice(found)}")
    output.result(gamma=found.gamma, determined=found.determined)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    """Find the gamma of photographs that a fixed camera took of one object under many lights.

    Attributes:
        photos: Folder of JPEG, PNG or TIFF files; the camera did not move.
        mask: Image that is bright on the object and dark off it, of the photographs' size.
        rank: 3 if point lights are far away and the room is dark, 4 with ambient light.
        max_size_px: Shrink photographs whose longer side is longer; 0 leaves them.
    """

    photos: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTOS")]
    mask: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    rank: Literal[3, 4] = 4
    max_size_px: int = 0


def checked(command: str, arguments: Sequence[str]) -> _Job:
    """Parse the arguments, and refuse photographs and a mask that do not exist."""
    job = read_arguments(_Job, command, arguments)
    list_images(job.photos)
    if job.mask is not None and not job.mask.is_file():
        raise InputError(
            f"{job.mask}: there is no such file; needed: a mask, bright on the object, for all "
            "photographs."
        )
    return job


def advice(found: "GammaEstimate") -> str:
    """Return the option of `pimper reconstruct` for the response; empty if it is not determined."""
    if not found.determined:
        return ""
    response = f"{found.gamma:.2f}"
    if found.residual_linear <= _AS_GOOD * found.residual:
        response = "linear"
    elif found.residual_srgb <= _AS_GOOD * found.residual:
        response = "srgb"
    return f"\n  pimper reconstruct PHOTOS -o RESULT --photographs.response {response}"
