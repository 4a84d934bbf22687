"""``pimper gamma``: estimate the response of photographs: a fixed camera, several lights."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from pimper_torch.cli.arguments import read_arguments
from pimper_torch.cli.output import Output
from pimper_torch.io.photograph_files import list_images
from pimper_torch.radiometry import LINEAR
from pimper_torch.runtime.errors import InputError, caution, held

if TYPE_CHECKING:
    from pimper_torch.single_view.factorization.estimate_gamma import GammaEstimate

# Multiple of the best residual below which a standard response is recommended; chosen by hand.
_AS_GOOD = 1.05


def run(job: "_Job", output: Output) -> None:
    """Run ``gamma``: print the estimate, and the matching option of `pimper reconstruct`."""
    from pimper_torch.io.photographs import load_views, read_mask
    from pimper_torch.io.responses import CONTRADICTED
    from pimper_torch.runtime.reporting import stage
    from pimper_torch.single_view.factorization.estimate_gamma import gamma_of_photographs

    with output.observer(), stage("read"), held() as cautions:
        views = load_views(job.photos, encoding=LINEAR, max_size_px=job.max_size_px)
    for each in cautions:
        if CONTRADICTED not in each.message:  # profiles of the files do not matter here
            caution(each.message)
    mask = None if job.mask is None else read_mask(job.mask, job.max_size_px)
    estimate = gamma_of_photographs(views, mask=mask, rank=job.rank)
    output.emit(f"{estimate}{advice(estimate)}")
    output.result(gamma=estimate.gamma, determined=estimate.determined)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    """Estimate the gamma of photographs of a static object from a fixed camera under many lights.

    Attributes:
        photos: Folder of JPEG, PNG or TIFF files; the camera did not move.
        mask: Mask of the object, bright on it and dark elsewhere, of the photographs' size.
        rank: 3 for distant point lights in a dark room, 4 with ambient light.
        max_size_px: Longer side to which larger photographs are scaled down; 0 keeps all sizes.
    """

    photos: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTOS")]
    mask: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    rank: Literal[3, 4] = 4
    max_size_px: int = 0


def checked(command: str, arguments: Sequence[str]) -> _Job:
    """Return the arguments, and refuse missing photographs or masks."""
    job = read_arguments(_Job, command, arguments)
    list_images(job.photos)
    if job.mask is not None and not job.mask.is_file():
        raise InputError(
            f"{job.mask}: there is no such file; needed: a mask for all photographs, bright on the "
            "object."
        )
    return job


def advice(estimate: "GammaEstimate") -> str:
    """Return the option of `pimper reconstruct` for the response; empty if it is not determined."""
    if not estimate.determined:
        return ""
    response = f"{estimate.gamma:.2f}"
    if estimate.residual_linear <= _AS_GOOD * estimate.residual:
        response = "linear"
    elif estimate.residual_srgb <= _AS_GOOD * estimate.residual:
        response = "srgb"
    return f"\n  pimper reconstruct PHOTOS -o RESULT --photographs.response {response}"
