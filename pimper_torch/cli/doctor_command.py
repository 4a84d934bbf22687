"""``pimper doctor``: check the installation, and photographs before a run."""

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from pimper_torch.cli.arguments import read_arguments
from pimper_torch.cli.doctor.cost import working_size
from pimper_torch.cli.doctor.findings import Finding, machine
from pimper_torch.cli.output import Output
from pimper_torch.io.photograph_files import list_images
from pimper_torch.radiometry import FROM_FILES, Encoding


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    """Check the installation, and whether photographs are suitable for a run, in seconds.

    Checks of photographs are number, sizes, blur, saturation, exposure and overlap, with advice,
    and estimates of time and memory. The exit code is 2 if a run would be refused.

    Attributes:
        photos: Folder of JPEG, PNG or TIFF files; without it, only the machine is checked.
        max_size_px: Longer side of shrunk photographs, 0 for none; by default as in a run.
        photographs: Encoding of the photographs.
    """

    photos: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="PHOTOS")] = None
    max_size_px: int | None = None
    photographs: Encoding = FROM_FILES


def run(job: _Job, output: Output) -> None:
    """Run ``doctor``: print one line per finding, with advice."""
    from pimper_torch.cli.doctor.checks import examine_views
    from pimper_torch.cli.doctor.photograph import EXAMINED_PX
    from pimper_torch.io.photographs import load_views, photograph_sizes, shrunk_size
    from pimper_torch.io.radiance import refuse_outlier
    from pimper_torch.runtime.reporting import stage

    findings = list(machine())
    _print(output, findings)
    if job.photos is not None:
        with output.observer(), stage("examine"):
            files_px = photograph_sizes(job.photos)
            longest, shrunk = working_size([*files_px.values()], job.max_size_px)
            in_run = {name: shrunk_size(*size, longest) for name, size in files_px.items()}
            refuse_outlier([job.photos / name for name in in_run], [*in_run.values()])
            examined = min(longest or EXAMINED_PX, EXAMINED_PX)
            views = load_views(job.photos, encoding=job.photographs, max_size_px=examined)
            photo_findings = examine_views(views, in_run, together=True, shrunk=shrunk)
        _print(output, photo_findings)
        findings += photo_findings
    warnings = [finding.check for finding in findings if finding.severity == "warning"]
    output.result(warnings=warnings)


def checked(command: str, arguments: Sequence[str]) -> _Job:
    """Read the arguments, and refuse a folder without photographs."""
    job = read_arguments(_Job, command, arguments, levels=True)
    if job.photos is not None:
        list_images(job.photos)
    return job


def _print(output: Output, findings: Iterable[Finding]) -> None:
    for finding in findings:
        output.event("finding", **dataclasses.asdict(finding))
        output.emit(f"{finding.severity:<8} {finding.check:<11} {finding}")
