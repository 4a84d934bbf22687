"""``pimper clean``: free the disk space of interrupted runs."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from pimper_torch.cli.arguments import read_arguments
from pimper_torch.cli.output import Output
from pimper_torch.export.result_folder.folders import clean_output, require_cleanable


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    """Delete the records that runs kept in OUT to continue later, and files of killed runs.

    The result itself stays.

    Attributes:
        out: Folder of a run, given to it as `-o OUT`.
    """

    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]


def run(job: _Job, output: Output) -> None:
    """Run ``clean``, and report the freed space."""
    freed = clean_output(job.out)
    outcome = f"{freed / 1e6:.1f} MB freed" if freed else "nothing to remove"
    output.remark(f"{job.out}: {outcome}.")
    output.result({"folder": job.out}, freed_bytes=freed)


def checked(command: str, arguments: Sequence[str]) -> _Job:
    """Return the arguments, and refuse folders that no run wrote."""
    job = read_arguments(_Job, command, arguments)
    require_cleanable(job.out)
    return job
