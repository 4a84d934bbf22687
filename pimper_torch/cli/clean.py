"""``pimper clean``: the room that interrupted runs take."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from pimper_torch.cli.arguments import read_arguments
from pimper_torch.cli.output import Output
from pimper_torch.doors.result_folder.folders import clean_output, require_cleanable


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    """Remove what a run into OUT kept to go on from, and what killed runs left there.

    The result itself stays.

    Attributes:
        out: Folder that was given to a run as `-o OUT`.
    """

    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]


def run(job: _Job, output: Output) -> None:
    """Carry out ``clean``, and tell how much was freed."""
    freed = clean_output(job.out)
    outcome = f"{freed / 1e6:.1f} MB freed" if freed else "nothing to remove"
    output.remark(f"{job.out}: {outcome}.")
    output.result({"folder": job.out}, freed_bytes=freed)


def checked(command: str, arguments: Sequence[str]) -> _Job:
    """Read the arguments, and refuse a folder that is not ours."""
    job = read_arguments(_Job, command, arguments)
    require_cleanable(job.out)
    return job
