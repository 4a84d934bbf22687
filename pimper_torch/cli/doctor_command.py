"""``pimper doctor``: what is installed, and what photographs are worth, before a run."""

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from pimper_torch.cli.arguments import read_arguments
from pimper_torch.cli.doctor.findings import Finding, machine
from pimper_torch.cli.output import Output
from pimper_torch.doors.io.photograph_files import list_images
from pimper_torch.ground.radiometry import FROM_FILES, Encoding


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    """Report what is installed here, and whether photographs are fit for a run, in seconds.

    Of photographs: number, sizes, blur, saturation, exposure, overlap, and an estimate of time
    and memory; each with what to do. Exit code 2 where a run would be refused.

    Attributes:
        photos: Folder of JPEG, PNG or TIFF files; without it, the machine alone.
        max_size_px: As of `pimper reconstruct`.
        photographs: As of `pimper reconstruct`.
    """

    photos: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="PHOTOS")] = None
    max_size_px: int = 0
    photographs: Encoding = FROM_FILES


def run(job: _Job, output: Output) -> None:
    """Carry out ``doctor``: tell each finding in a line, with what to do."""
    from pimper_torch.cli.doctor.checks import examine_folder
    from pimper_torch.runtime.reporting import stage

    findings = list(machine())
    _print(output, findings)
    if job.photos is not None:
        with output.observer(), stage("examine"):
            found = examine_folder(job.photos, job.photographs, job.max_size_px)
        _print(output, found)
        findings += found
    output.result(warnings=[one.check for one in findings if one.severity == "warning"])


def checked(command: str, arguments: Sequence[str]) -> _Job:
    """Read the arguments, and refuse a folder without photographs."""
    job = read_arguments(_Job, command, arguments, levels=True)
    if job.photos is not None:
        list_images(job.photos)
    return job


def _print(output: Output, findings: Iterable[Finding]) -> None:
    for one in findings:
        output.event("finding", **dataclasses.asdict(one))
        output.emit(f"{one.severity:<8} {one.check:<11} {one}")
