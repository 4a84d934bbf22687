"""``pimper markers``: write a sheet of markers, photographed with an object for its real size."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from pimper_torch.cli.arguments import Flag, read_arguments
from pimper_torch.cli.output import Output
from pimper_torch.export.result_folder.files import file_written_whole, prepare_file
from pimper_torch.runtime.config import require
from pimper_torch.scale.sheet import SIDE_MM, TITLE, Paper, layout


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    """Write a PDF with markers, to print and to photograph together with an object.

    Results are then in millimetres. Larger markers are recognised from farther away.

    Attributes:
        out: PDF file, such as sheet.pdf.
        paper: Paper size.
        side_mm: Side of the markers' black squares in millimetres, 10 to 36.
        overwrite: Replace an earlier sheet.
    """

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="SHEET")]
    paper: Paper = "a4"
    side_mm: int = SIDE_MM
    overwrite: Flag = False


def run(job: _Job, output: Output) -> None:
    """Run ``markers``."""
    from pimper_torch.viz.marker_sheet import write_sheet

    with file_written_whole(job.out) as fresh:
        write_sheet(fresh, job.side_mm, job.paper)
    output.remark(
        f"{job.out}: print it at 100 %, check its ruler, and photograph it with the object. "
        "`pimper reconstruct` detects the markers automatically."
    )
    output.result({"sheet": job.out}, side_mm=job.side_mm)


def checked(command: str, arguments: Sequence[str]) -> _Job:
    """Return the arguments, and refuse to replace other files than sheets."""
    job = read_arguments(_Job, command, arguments)
    require(job.out.suffix.lower() == ".pdf", "SHEET", job.out.name, "a name ending in .pdf")
    layout(job.side_mm, job.paper)
    prepare_file(job.out, job.overwrite, TITLE)
    return job
